"""What `rollerrig tune velim`, `validate velim` and `validate sanding` do.

Each function takes the parsed command line and returns the exit status.
"""

import argparse
import json
from pathlib import Path

import tomli_w

from paper import sanding, synthetic_stops, velim
from rollerrig.realtime.commands import output

TESTS = [test.upper() for test in velim.TESTS]


def tune_velim(given: argparse.Namespace) -> int:
    """Find on group A what the paper does not print; --synthetic writes the dataset instead."""
    if given.synthetic:
        out = given.out or Path("velim_synthetic")
        folder = synthetic_stops.write(out, given.seed + 1)
        return output.show(given, {"dataset": str(folder)}, f"synthetic dataset: {folder}")

    found = velim.calibrate(output.print_message)
    out = given.out or Path("reports/tune_velim")
    out.mkdir(parents=True, exist_ok=True)
    file = out / "velim.toml"
    file.write_text("# found on group A of Table 6\n" + tomli_w.dumps(found), encoding="utf-8")
    return _compare(given, found, out, f"written to {file}; copy it to {velim.SETTINGS} to use it")


def validate_velim(given: argparse.Namespace) -> int:
    """Compare the six stops with Table 6, with the settings that were found on group A."""
    return _compare(given, velim.settings(), given.out)


def _compare(
    given: argparse.Namespace, found: dict[str, float], out: Path | None, *last: str
) -> int:
    """Run the six stops, and print Table 6 with our rows and those of the paper."""
    ours = velim.table6(found, output.print_message)
    from_mean = velim.from_measured_means(found, output.print_message)
    classic = velim.from_measured_means(found, output.print_message, velim.CLASSIC)
    result = velim.as_json(found, ours, from_mean, classic)
    if out:
        out.mkdir(parents=True, exist_ok=True)
        (out / "velim.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")

    fitted = ", ".join(f"{name} {value:.4g}" for name, value in found.items())
    error = result["group_b_mean_absolute_error"]
    return output.show(
        given,
        result,
        ("Table 6", ("m/s", *TESTS), velim.rows_for_table(ours, from_mean, classic)),
        (
            "contaminant mu_cd",
            ("", *TESTS),
            velim.rows_of_contaminants(found, from_mean, classic),
        ),
        "with recovery, a contaminant below the printed 0.06 is needed: that is the level of a law "
        "that was tuned on measured torques, which the paper does not print; under our full "
        "service brake and our reference WSP, wheels on 0.06 clean the rail so much that they "
        "slide less than measured",
        f"fitted on group A (A1 to A3): {fitted}; residual: "
        f"{result['group_a_left_over_rms_m_s']:.2f} m/s rms",
        "predicted: group B, with the speeds of Table 5 alone and mu_cd = "
        f"{result['predicted_mu_cd_group_b']:.4g}; Table 4 and tau as printed, wheels on the track",
        "mean sliding of a test that has not been run, 95 %: ours +- "
        f"{velim.half_width_m_s():.1f} m/s (Student's t, from the spread of the three measured "
        "means of group A)",
        f"group B, mean absolute error against measured: mean {error['mean_m_s']:.2f} (paper's "
        f"model {error['paper_mean_m_s']:.2f}), deviation {error['deviation_m_s']:.2f} (paper's "
        f"model {error['paper_deviation_m_s']:.2f}) m/s",
        (
            "what can be predicted of group B's mean sliding, m/s",
            (
                "found on group A's measured means, as a function of initial speed alone",
                *(test.upper() for test in velim.GROUP_B),
                "error",
            ),
            _rows_of_bounds(),
        ),
        "E1 needs the recordings, which are not public; 'rollerrig validate DATASET' prints it for "
        "other data",
        *last,
    )


def _rows_of_bounds() -> list[tuple[str, ...]]:
    """Return the predictions for group B and the error of each rule, then the measured means."""
    rows: list[tuple[str, ...]] = []
    for bound in velim.bounds():
        predicted = [f"{mean:.2f}" for mean in bound.predicted_m_s]
        rows.append((bound.name, *predicted, f"{bound.error_m_s:.2f}"))
    measured = [f"{velim.MEASURED_MEAN[test]:.2f}" for test in velim.GROUP_B]
    rows.append(("measured", *measured, ""))
    return rows


def validate_sanding(given: argparse.Namespace) -> int:
    """Compare the law of sand with the stops of RSSB T1107."""
    result = sanding.study()
    rows = []
    for stop in result["stops"]:
        rows.append(
            (
                stop["stop"],
                f"{stop['measured_m']:.0f}",
                f"{stop['by_the_law_m']:.0f}",
                "fitted" if stop["fitted"] else "predicted",
            )
        )
    return output.show(
        given,
        result,
        (
            "stops with sand from 55 mph on 0.02, RSSB T1107 (without sand: more than 1,200 m)",
            ("stop", "measured m", "by the law m", ""),
            rows,
        ),
        f"gain {result['gain']:.3g}, dose scale {result['dose_scale_kg_m']:.3g} kg/m: "
        "the values of [sanders]",
    )
