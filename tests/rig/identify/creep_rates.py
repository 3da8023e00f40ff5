"""How often the judgement of creep curves is right, on curves with known truth.

    python tests/rig/identify/creep_rates.py 200

prints for each truth of `creep_generators` how many of 200 curves were answered rightly, with the
95 % interval of the rate, and the seeds that were not. A second table has the magic formula in the
forms in which curves are measured.
"""

import argparse
import sys
from typing import NamedTuple

import creep_generators as generators
from scipy.stats import binomtest

from rollerrig.rig.identify.creep_curves import judgement
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.data.runs import Curve

FORMS = (*generators.LEVEL_FORMS, *generators.FALLING_FORMS)
ALL = (
    *generators.NOTHING,
    *generators.BLOCKS,
    generators.LOAD,
    generators.SERIES,
    generators.FALLING,
)


class Answers(NamedTuple):
    """The answers on curves of one truth; seeds of wrong ones."""

    truth: generators.Truth
    curves: int
    false_reports: list[int]  # something was reported that is not in the truth
    missed: list[int]  # the truth was not reported, though its size was said to be visible
    too_small: list[int]  # the truth was not reported, and its size was said to be too small
    outside: list[int]  # the interval of the size does not contain the truth


def judge(truth, seed):
    """Return what the points of a curve show."""
    points = generators.curve(truth, seed)
    base = dataset.load("eurosprinter_127001")
    return judgement.without_law(base._replace(curve=Curve(*points)), seed)


def answers(truth, seeds):
    """Return the answers on curves of one truth."""
    wanted = set()
    if truth.fall:
        wanted.add(judgement.FALLING_FRICTION)
    if truth.load_exponent:
        wanted.add("load")
    if truth.series_change:
        wanted.add("series")

    false_reports = []
    missed = []
    too_small = []
    outside = []
    for seed in seeds:
        shown = judge(truth, seed)
        found = {effect.name for effect in shown.reported}
        if shown.falls:
            found.add(judgement.FALLING_FRICTION)
        if found - wanted:
            false_reports.append(seed)
        if wanted - found:
            is_too_small = truth.fall and shown.fall.size < shown.fall.smallest
            if "load" in wanted - found:
                smallest = next(e.smallest for e in shown.factors.effects if e.name == "load")
                is_too_small = abs(_change_by_load(truth)) < smallest
            (too_small if is_too_small else missed).append(seed)
        for effect in shown.reported:
            size = truth.series_change
            if effect.name == "load":
                size = _change_by_load(truth)
            if not effect.low <= size <= effect.high:
                outside.append(seed)
    return Answers(truth, len(seeds), false_reports, missed, too_small, outside)


def _change_by_load(truth):
    """Return the change of adhesion from the lowest load to the highest."""
    ratio = 1.5 if truth in generators.BLOCKS else 3.0
    return ratio**truth.load_exponent - 1.0


def answers_on_forms(truth, seeds):
    """Return the answers on magic formulas in the form of a truth."""
    base = dataset.load("eurosprinter_127001")
    false_reports = []
    missed = []
    too_small = []
    outside = []
    for seed in seeds:
        points, true_fall = generators.tyre_curve(truth, seed)
        shown = judgement.without_law(base._replace(curve=Curve(*points)), seed)
        found = {effect.name for effect in shown.reported}
        if "two directions" in truth.form:
            # they differ by up to 15 %
            found.discard("direction")
        if found or (shown.falls and not truth.fall):
            false_reports.append(seed)
        if truth.fall and not shown.falls:
            is_too_small = bool(shown.fall_why_not) or true_fall < shown.fall.smallest
            (too_small if is_too_small else missed).append(seed)
        if truth.fall and shown.falls and not shown.fall.low <= true_fall <= shown.fall.high:
            outside.append(seed)
    return Answers(truth, len(seeds), false_reports, missed, too_small, outside)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("curves", type=int, help="curves of each truth")
    parser.add_argument("--first", type=int, default=0, help="first seed (default: 0)")
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.curves)
    total = 0
    false_total = 0
    print("| truth | false reports | missed | said to be too small | outside the interval |")
    print("|---|---|---|---|---|")
    for truth in (*ALL, *FORMS):
        found = answers_on_forms(truth, seeds) if truth.form else answers(truth, seeds)
        total += found.curves
        false_total += len(found.false_reports)
        cells = [_cell(part, found.curves) for part in found[2:5]]
        reported = found.curves - len(found.missed) - len(found.too_small)
        has_size = truth.load_exponent or truth.series_change or (truth.form and truth.fall)
        cells.append(_cell(found.outside, reported) if has_size else "")
        print(f"| {truth.name} | {' | '.join(cells)} |", flush=True)
    print(f"false reports: {_rate(false_total, total)}")


def _rate(count, of):
    low, high = binomtest(count, of).proportion_ci(method="exact")
    return f"{count} of {of} (95 % interval {100 * low:.2g} to {100 * high:.2g} %)"


def _cell(seeds, of):
    text = _rate(len(seeds), of)
    return f"{text}; seeds {', '.join(map(str, seeds))}" if seeds else text


if __name__ == "__main__":
    sys.exit(main())
