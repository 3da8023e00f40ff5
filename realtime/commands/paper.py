"""`rollerrig tune` and `rollerrig validate`: what the paper does with measured runs, and with its own stops.

`tune` finds tau of the recovery (or Polach's parameters) on the tuning runs, with intervals; `validate`
makes Table 6 on runs that were never fitted. The dataset `velim` is the paper's six stops in closed
loop: what it does not print is found on group A, and group B is predicted.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output, study

VELIM, SANDING = "velim", "sanding"


def tune_arguments(parser: argparse.ArgumentParser) -> None:
    _arguments(parser, "tune", "find what the paper does not print on its group A")
    parser.add_argument(
        "--synthetic",
        action="store_true",
        help="with 'velim': make the synthetic dataset of the six stops in --out, and tune nothing",
    )


def validate_arguments(parser: argparse.ArgumentParser) -> None:
    _arguments(
        parser,
        "validate",
        "the paper's six stops in closed loop; or 'sanding': the "
        "sand's law against stops that were measured",
    )
    parser.add_argument(
        "--tau",
        type=float,
        metavar="m/J",
        help="recovery to judge (default: tuned on "
        "the dataset's tuning runs); folders of runs need it",
    )


def _arguments(parser: argparse.ArgumentParser, verb: str, of_velim: str) -> None:
    parser.add_argument(
        "dataset",
        nargs="+",
        help="folder of a dataset, name of a packaged one, folders "
        f"of runs, or 'velim': {of_velim}",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"folder of the report (default: reports/{verb}_NAME)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the bootstrap (default: 0)")


def tune(given: argparse.Namespace) -> int:
    if given.dataset == [VELIM]:
        return _tune_velim(given)
    from rollerrig.realtime.reports import tuning as report
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.paper import polach_fit

    data, out = study.open_dataset(given.dataset, given.out, "tune")
    if data.kind == "creep_curve":
        fitted = polach_fit.fit(data, given.seed)
        result = report.polach_json(data, fitted)
        study.write_report(out, "tune", result, report.polach_page(data, fitted))
        return output.show(
            given,
            result,
            (f"fitted to {data.name}", report.HEAD, report.polach_rows(result)),
            f"report: {out / 'tune.html'}",
        )
    found = _tuned(data, given.seed)
    result = report.tune_json(data, found)
    study.write_report(out, "tune", result, report.tune_page(data, found))
    study_view.tuned(out / "tune.rrd", data, found)
    (out / "tuned.toml").write_text(
        f"# tuned on {data.name} by rollerrig tune; load it with: rollerrig run ... "
        f"--model\n[adhesion]\ntau_m_J = {found.tau_m_J.value!r}\n",
        encoding="utf-8",
    )
    return output.show(
        given,
        result,
        (f"tuned on {data.name}", report.HEAD, report.tune_rows(result)),
        f"report: {out / 'tune.html'}, {out / 'tune.rrd'}; model: {out / 'tuned.toml'}",
    )


def validate(given: argparse.Namespace) -> int:
    if given.dataset == [SANDING]:
        return _show_sanding(given)
    if given.dataset == [VELIM]:
        from rollerrig.realtime.studies import velim

        return _compare_velim(given, velim.settings(), given.out)
    from rollerrig.realtime.reports import tuning as report
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.paper import tuning, validation

    if given.tau is not None and not 0.0 <= given.tau <= 1.0:
        raise ConfigError(
            f"--tau {given.tau:g} m/J is out of range; allowed 0 to 1, the paper has 1.9e-4"
        )
    data, out = study.open_dataset(given.dataset, given.out, "validate")
    if data.kind != "braking_runs":
        raise ConfigError(
            f"{given.dataset[0]}: a {data.kind} cannot be validated, it has no runs; use rollerrig tune"
        )
    tau = (
        tuning.Interval(given.tau, given.tau, given.tau)
        if given.tau is not None
        else _tuned(data, given.seed).tau_m_J
    )
    group = "validate" if data.group("validate") or given.tau is None else "tune"
    verdicts = validation.validate(data, tau.value, group)
    result = report.validate_json(data, tau, verdicts)
    study.write_report(out, "validate", result, report.validate_page(data, tau, verdicts))
    study_view.validated(out / "validate.rrd", data, verdicts)
    return output.show(
        given,
        result,
        (
            f"{result['dataset']}: Table 6 with tau = {tau.value:.4g} m/J, m/s",
            *report.table6(verdicts),
        ),
        *(
            f"{name:8} mean absolute error: mean sliding {error['mean_1_m_s']:.3f} m/s, standard deviation "
            f"{error['std_1_m_s']:.3f} m/s (wheelset 1); rms of f {error['adhesion_rmse']:.4f}"
            for name, error in result["errors"].items()
        ),
        f"report: {out / 'validate.html'}, {out / 'validate.rrd'}",
    )


def _show_sanding(given: argparse.Namespace) -> int:
    from rollerrig.realtime.studies import sanding

    result = sanding.study()
    rows = [
        (
            one["stop"],
            f"{one['measured_m']:.0f}",
            f"{one['by_the_law_m']:.0f}",
            "fitted" if one["fitted"] else "predicted",
        )
        for one in result["stops"]
    ]
    return output.show(
        given,
        result,
        (
            "stops with sand from 55 mph on 0.02, RSSB T1107 (without sand: more than 1,200 m)",
            ("stop", "measured m", "by the law m", ""),
            rows,
        ),
        f"gain {result['gain']:.3g}, dose scale {result['dose_scale_kg_m']:.3g} kg/m: those of [sanders]",
    )


def _tuned(data: Any, seed: int) -> Any:
    from rollerrig.rig.identify.paper import tuning

    with output.progress_of(lambda: f"tuning on {data.name}"):
        return tuning.tune(data, seed)


# --- the paper's own stops ---


def _tune_velim(given: argparse.Namespace) -> int:
    import tomli_w

    from rollerrig.realtime.datasets import run_dataset
    from rollerrig.realtime.studies import velim

    if given.synthetic:
        folder = run_dataset.velim_synthetic(given.out or Path("velim_synthetic"), given.seed + 1)
        return output.show(given, {"dataset": str(folder)}, f"synthetic dataset: {folder}")
    found = velim.calibrate(output.say)
    out = given.out or Path("reports/tune_velim")
    out.mkdir(parents=True, exist_ok=True)
    (out / "velim.toml").write_text(
        "# found on group A of Table 6\n" + tomli_w.dumps(found), encoding="utf-8"
    )
    return _compare_velim(
        given, found, out, f"written to {out / 'velim.toml'}; it takes effect as configs/velim.toml"
    )


def _compare_velim(
    given: argparse.Namespace, found: dict[str, float], out: Path | None, *last: str
) -> int:
    """Run the six stops under what was found on group A, and print Table 6, ours beside the paper's."""
    from rollerrig.realtime.studies import velim

    ours = velim.table6(found, output.say)
    own, classic = (
        velim.owns(found, output.say),
        velim.owns(found, output.say, "adhesion.tau_m_J=0.0"),
    )
    result = velim.as_json(found, ours, own, classic)
    if out:
        out.mkdir(parents=True, exist_ok=True)
        (out / "velim.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    off = result["group_b_mean_absolute_error"]
    return output.show(
        given,
        result,
        (
            "Table 6",
            ("m/s", *map(str.upper, velim.TESTS)),
            velim.rows_for_table(ours, own, classic),
        ),
        (
            "contaminant mu_cd",
            ("", *map(str.upper, velim.TESTS)),
            velim.rows_of_contaminants(found, own, classic),
        ),
        "with recovery a contaminant below the printed 0.06 is needed: that is the level of a law tuned on measured "
        "torques, which the paper does not print; under our full service brake and reference WSP wheels on 0.06 clean "
        "the rail so far that they slide less than measured",
        "fitted on group A (A1 to A3): "
        + ", ".join(f"{k} {v:.4g}" for k, v in found.items())
        + f"; left over there: {result['group_a_left_over_rms_m_s']:.2f} m/s rms",
        "predicted: group B, with Table 5's speeds alone and mu_cd = "
        f"{result['predicted_mu_cd_group_b']:.4g}; Table 4 and tau as printed, wheels on the track",
        "the mean of a test not yet run, 95 %: ours +- "
        f"{velim.half_width_m_s():.1f} m/s (Student's t, from the spread of group A's three measured means)",
        f"group B, mean absolute error against measured: mean {off['mean_m_s']:.2f} (paper's model "
        f"{off['paper_mean_m_s']:.2f}), deviation {off['deviation_m_s']:.2f} (paper's model "
        f"{off['paper_deviation_m_s']:.2f}) m/s",
        (
            "what can be predicted of group B's mean sliding, m/s",
            (
                "found on group A's measured means, as a function of initial speed alone",
                "B1",
                "B2",
                "B3",
                "error",
            ),
            [
                *(
                    (one.name, *(f"{x:.2f}" for x in (*one.predicted_m_s, one.error_m_s)))
                    for one in velim.bounds()
                ),
                ("measured", *(f"{velim.MEASURED_MEAN[test]:.2f}" for test in velim.GROUP_B), ""),
            ],
        ),
        "E1 needs the recordings, which are not public; it is printed by 'rollerrig validate DATASET' for data at hand",
        *last,
    )
