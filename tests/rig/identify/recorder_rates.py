"""How often a recording is judged rightly, on twins: `python tests/rig/identify/recorder_rates.py CLEAN EACH [SEED]`.

Clean twins in seven kinds (channels that a recorder has or lacks), then each defect so often, with how many were named
alone, on the right channel and run, and how many 95 % intervals hold the truth.
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


def judged(folder, seed, hide=(), **how):
    told = twin.dataset(folder, twin.stops("clean"), seed, hide, **how)
    return told, verdict.explain(recording.load(folder))


def main(clean, each, seed=1000):
    with tempfile.TemporaryDirectory() as folder:
        wrong = 0
        for k in range(clean):
            _, account = judged(folder, seed + k, **KINDS[k % len(KINDS)])
            if account.verdict != "consistent":
                wrong += 1
                print(f"seed {seed + k} {KINDS[k % len(KINDS)]}: {report.story(account)}")
        if clean:
            low, high = binomtest(wrong, clean).proportion_ci(method="wilson")
            print(
                f"clean: {wrong} of {clean} not consistent, {wrong / clean:.1%} ({low:.1%} to {high:.1%})"
            )
        for hide in (*twin.BEFORE, *twin.AFTER) if each else ():
            named = alone = rows = covered = 0
            for k in range(each):
                told, account = judged(folder, seed + 10_000 + k, (hide,))
                found = [*account.findings, *account.unknown]
                mine = {
                    row: [
                        f
                        for f in found
                        if f.name == row[0] and row[1] in f.channels and row[2] in (None, f.run)
                    ]
                    for row in told
                }
                named += all(mine.values())
                alone += {f.name for f in found} == {row[0] for row in told}
                sized = [(row, fs[0]) for row, fs in mine.items() if fs and row[5] is not None]
                rows, covered = (
                    rows + len(sized),
                    covered + sum(f.low <= row[5] <= f.high for row, f in sized),
                )
            print(
                f"| {hide.__name__} | {named} of {each} | {alone} of {each} | "
                f"{f'{covered} of {rows}' if rows else '-'} |",
                flush=True,
            )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
