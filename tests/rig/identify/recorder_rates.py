"""Measures how often `explain` is right about simulated recordings ("twins").

    python tests/rig/identify/recorder_rates.py CLEAN EACH [SEED]

CLEAN is the number of twins without a defect. They are of seven kinds, with different channels. The
program counts those that are not consistent.

EACH is the number of twins with each defect. The program counts the twins whose defect is named on
the right channel and run, the twins where nothing else is named, and the 95 % intervals that hold
the truth.
"""

import sys
import tempfile

import recorder_twin as twin
from scipy.stats import binomtest

from rollerrig.realtime.reports import recorder as report
from rollerrig.rig.identify.train_recorder import recording, verdict

KINDS = (
    {},
    {"reference": False},
    {"axles": 2},
    {"axles": 1},
    {"axles": 2, "reference": False},
    {"axles": 3, "position": False},
    {"axles": 1, "reference": False},
)

# distance of the seeds of twins with a defect from those of clean twins
DEFECT_SEEDS = 10_000


def explained(folder, seed, defects=(), **channels):
    """Return the truths of a twin, and its explanation."""
    truths = twin.dataset(folder, twin.stops("clean"), seed, defects, **channels)
    return truths, verdict.explain(recording.load(folder))


def show_clean(folder, count, seed):
    """Print how many twins without a defect are neither consistent nor, rightly, not judged."""
    wrong = 0
    for k in range(count):
        channels = KINDS[k % len(KINDS)]
        _, account = explained(folder, seed + k, **channels)
        # one speed alone shows no slide
        right = "not_judged" if channels == KINDS[-1] else "consistent"
        if account.verdict != right:
            wrong += 1
            print(f"seed {seed + k} {channels}: {report.story(account)}")
    low, high = binomtest(wrong, count).proportion_ci(method="wilson")
    share = f"{wrong / count:.1%} ({low:.1%} to {high:.1%})"
    print(f"clean: {wrong} of {count} wrong, {share}")


def show_defect(folder, defect, count, seed):
    """Print a row of the table: how often one defect is named."""
    named = 0
    alone = 0
    intervals = 0
    covered = 0
    for k in range(count):
        truths, account = explained(folder, seed + DEFECT_SEEDS + k, (defect,))
        findings = [*account.findings, *account.unknown]
        first_matches = [first_match(findings, true) for true in truths]
        if None not in first_matches:
            named += 1
        if {finding.name for finding in findings} == {true.name for true in truths}:
            alone += 1
        for true, finding in zip(truths, first_matches, strict=True):
            if finding is not None and true.size is not None:
                intervals += 1
                if finding.low <= true.size <= finding.high:
                    covered += 1
    coverage = f"{covered} of {intervals}" if intervals else "-"
    name = defect.__name__
    print(f"| {name} | {named} of {count} | {alone} of {count} | {coverage} |", flush=True)


def first_match(findings, true):
    """Return the first finding that is right about a hidden defect; None if there is none."""
    for finding in findings:
        if is_right(finding, true):
            return finding
    return None


def is_right(finding, true):
    """Return whether a finding has the name, the channel and the run of a hidden defect."""
    return (
        finding.name == true.name
        and true.channel in finding.channels
        and true.run in (None, finding.run)
    )


def main(clean, each, seed=1000):
    with tempfile.TemporaryDirectory() as folder:
        if clean:
            show_clean(folder, clean, seed)
        if each:
            for defect in (*twin.BEFORE, *twin.AFTER):
                show_defect(folder, defect, each, seed)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
