"""Prints what the reference unit, no unit and each flawed unit do in packaged sequences.

    python tests/wsp_interface/judge_flawed.py emergency_080 very_low_080 [--pass]

For each stop: the result, measures of the limits, and the limits that it exceeds. `--pass` prints
only stops that pass. The stops are played in memory (`memory_bench`).
"""

import argparse

import flawed_units
import memory_bench

from rollerrig.firmware_sim.faults import catalogue
from rollerrig.wsp_interface.sequences import sequence
from rollerrig.wsp_interface.sequences.measures import BY_NAME
from rollerrig.wsp_interface.sequences.verdict import Result

SHOWN = (
    "stop_distance",
    "stop_distance_over_rail",
    "utilised_over_initial_adhesion",
    "longest_lock",
    "longest_deep_slide",
    "locked_distance",
    "vents_per_second",
    "air_consumption",
    "reservoir_least",
)
KINDS = (flawed_units.Unit, None, *flawed_units.FLAWED)


def judged(name, kind):
    """Return the outcome of a sequence with a kind of unit, or without one (None)."""
    one = sequence.load(name, catalogue.parse)
    if kind is None:
        return memory_bench.played(one)
    config = memory_bench.command.scenario_of(one)["wsp_config"]
    return memory_bench.played(one, flawed_units.of(kind, config))


def line(name, kind, outcome):
    """Return the result of a stop in one line."""
    unit = "no unit" if kind is None else kind.__name__
    words = [f"{name:28} {unit:18} {outcome.result:5}"]
    for measure in SHOWN:
        value = float(BY_NAME[measure].of(outcome.record))
        words.append(f"{measure} {value:.4g}")
    for verdict in outcome.verdicts:
        if verdict.result in (Result.FAIL, Result.ERROR):
            words.append(f"[{verdict.result}: {verdict.against_limit}]")
    return "  ".join(words)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="+", help="packaged sequences")
    parser.add_argument("--pass", action="store_true", dest="passed", help="only stops that pass")
    given = parser.parse_args()
    for name in given.names:
        for kind in KINDS:
            outcome = judged(name, kind)
            if not given.passed or outcome.result is Result.PASS:
                print(line(name, kind, outcome), flush=True)


if __name__ == "__main__":
    main()
