"""How often a recording is explained rightly, on twins.

    python tests/rig/identify/recorder_rates.py CLEAN EACH [SEED]

CLEAN twins without a defect, of seven kinds (channels that a recorder has or lacks). Then EACH twins
with each defect: how many were named on the right channel and run, how many were named and nothing
else, and how many 95 % intervals hold the truth.
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

# seeds of twins with a defect begin so far behind those of clean twins
DEFECT_SEEDS = 10_000


def explained(folder, seed, defects=(), **channels):
    """Return what is true of a twin, and its explanation."""
    truths = twin.dataset(folder, twin.stops("clean"), seed, defects, **channels)
    return truths, verdict.explain(recording.load(folder))


def show_clean(folder, count, seed):
    """Print how many twins without a defect are not consistent."""
    wrong = 0
    for k in range(count):
        channels = KINDS[k % len(KINDS)]
        _, account = explained(folder, seed + k, **channels)
        if account.verdict != "consistent":
            wrong += 1
            print(f"seed {seed + k} {channels}: {report.story(account)}")
    low, high = binomtest(wrong, count).proportion_ci(method="wilson")
    share = f"{wrong / count:.1%} ({low:.1%} to {high:.1%})"
    print(f"clean: {wrong} of {count} not consistent, {share}")


def show_defect(folder, defect, count, seed):
    """Print a row of the table: how often one defect is named."""
    named = 0
    alone = 0
    intervals = 0
    covered = 0
    for k in range(count):
        truths, account = explained(folder, seed + DEFECT_SEEDS + k, (defect,))
        found = [*account.findings, *account.unknown]
        matches = [[finding for finding in found if is_right(finding, true)] for true in truths]
        named += all(matches)
        alone += {finding.name for finding in found} == {true.name for true in truths}
        for true, of_truth in zip(truths, matches, strict=True):
            if of_truth and true.size is not None:
                intervals += 1
                covered += of_truth[0].low <= true.size <= of_truth[0].high
    coverage = f"{covered} of {intervals}" if intervals else "-"
    name = defect.__name__
    print(f"| {name} | {named} of {count} | {alone} of {count} | {coverage} |", flush=True)


def is_right(finding, true):
    """Whether a finding has the name, the channel and the run of what was hidden."""
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
