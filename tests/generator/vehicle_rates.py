"""Measures how often `explain` finds a hidden cause on vehicles with any number of axles.

    python tests/generator/vehicle_rates.py bogie_low 20 FOLDER
    python tests/generator/vehicle_rates.py multiple_unit_low 10 FOLDER

A set has three stops of the scenario from different speeds, recorded by the bench; the third stop
judges. Each set has one hidden cause of `CAUSES`, and two sets of ten have none. The recordings get
the noise of the sensors of a test train. The stops come from the rig itself, so they are easier
than those of the three generators. The adhesion is `soap`: `low`, the default of these scenarios,
has rail cleaning in it, which the base model does not have, so that no set would be without a
cause.

Prints a row for each set, then how many are right, with the 95 % interval of Wilson. An answer is
right if its first cause is the hidden one or in a set of two with it. The reports stay in FOLDER,
and the same command continues after an interruption.
"""

import json
import sys
from pathlib import Path

from scipy.stats import binomtest

import rollerrig
from rollerrig.realtime.bench import scenario as scenarios
from rollerrig.realtime.datasets import run_dataset, run_sensors

# hidden cause: its parameters in [mechanisms]
CAUSES = {
    "rail_cleaning": {"rail_cleaning_gain": 0.4},
    "track_gradient": {"track_gradient_gradient": 0.008},
    "brake_gain": {"brake_gain_gain": 0.12, "brake_gain_axle": 1},
    "none": {},
    "wheel_radius": {"wheel_radius_fraction": 0.01, "wheel_radius_axle": 2},
    "friction_trend": {"friction_trend_rate_1_s": -0.02},
    "interfacial_layer": {"interfacial_layer_reduction": 0.7},
    "none_again": {},
    "speed_dependent_friction": {"speed_dependent_friction_slope_per_m_s": 0.015},
    "torque_offset": {"torque_offset_offset_Nm": 500.0},
}
NOTHING = ("none", "none_again")
# the speeds of the stops of a set, as shares of the speed of the scenario; the last one judges
SHARES = (1.0, 0.75, 0.87)


def answer(scenario: str, hidden: str, number: int, folder: Path) -> dict:
    """Return the report of a set; record and explain it unless the report is in the folder."""
    report = folder / "report" / "report.json"
    if report.exists():
        return json.loads(report.read_text(encoding="utf-8"))
    fastest_m_s = scenarios.load(scenario)["initial_speed_m_s"]
    # each round has other speeds
    slower = 1.0 - 0.04 * (number // len(CAUSES))
    stops = []
    for index, share in enumerate(SHARES):
        stop = rollerrig.run(
            scenario,
            out=folder / f"stop_{index}",
            seed=100 * number + index,
            adhesion="soap",
            initial_speed_m_s=slower * share * fastest_m_s,
            mechanisms=CAUSES[hidden],
        )
        stops.append(stop.folder)
    data = run_dataset.from_folders(
        stops[:-1],
        folder / "data",
        validate=stops[-1:],
        noise=run_sensors.TRAIN,
        slowest_m_s=run_dataset.SLOWEST_M_S,
    )
    return rollerrig.explain(data, out=folder / "report")


def is_right(hidden: str, report: dict) -> bool:
    """Return whether a report has the hidden cause first, or in a first set of two."""
    if hidden in NOTHING:
        return report["verdict"] == "consistent"
    if not report["causes"]:
        return False
    first = report["causes"][0]
    names = {first["name"], *first["confusable_with"]}
    return first["name"] == hidden or (len(names) == 2 and hidden in names)


def main(scenario: str, sets: int, folder: Path) -> None:
    """Answer the sets, and print a row for each and the rates."""
    names = list(CAUSES)
    right = 0
    wrong = 0
    for number in range(sets):
        hidden = names[number % len(names)]
        report = answer(scenario, hidden, number, folder / f"{scenario}_{number:02d}")
        found = [cause["name"] for cause in report["causes"]]
        good = is_right(hidden, report)
        right += good
        wrong += bool(found) and not good
        result = "right" if good else "not right"
        print(
            f"| {hidden} | {report['verdict']} | {', '.join(found) or '-'} | {result} |",
            flush=True,
        )
    interval = binomtest(right, sets).proportion_ci(method="wilson")
    print(f"{scenario}: {right} of {sets} right ({interval.low:.2f} to {interval.high:.2f})")
    print(f"{scenario}: a wrong cause in {wrong} of {sets}")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))
