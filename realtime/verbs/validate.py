"""`rollerrig validate`: Table 6 on runs that were never fitted, the classic model beside the new one."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

VELIM = "velim"


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", nargs="+", help="folder of a dataset, name of a packaged one, folders "
                        "of runs (with --tau), or 'velim': the paper's six stops in closed loop")
    parser.add_argument("--tau", type=float, metavar="m/J", help="recovery to judge (default: tuned on "
                        "the dataset's tuning runs)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the report (default: "
                        "reports/validate_NAME)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the bootstrap (default: 0)")


def call(given: argparse.Namespace) -> int:
    if given.dataset == [VELIM]:
        return _velim(given)
    from rollerrig.configs.errors import ConfigError
    from rollerrig.realtime.reports import paper
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.realtime.verbs import tune
    from rollerrig.rig.identify.paper import tuning, validation

    if given.tau is not None and not 0.0 <= given.tau <= 1.0:
        raise ConfigError(f"--tau {given.tau:g} m/J is out of range; allowed 0 to 1, the paper has 1.9e-4")
    data, out = tune.opened(given.dataset, given.out, "validate")
    if data.kind != "braking_runs":
        raise ConfigError(f"{given.dataset[0]}: a {data.kind} cannot be validated, it has no runs; use "
                          "rollerrig tune")
    tau = (tuning.Interval(given.tau, given.tau, given.tau) if given.tau is not None
           else tuning.tune(data, given.seed).tau_m_J)
    group = "validate" if data.group("validate") or given.tau is None else "tune"
    verdicts = validation.validate(data, tau.value, group)
    result = paper.validate_json(data, tau, verdicts)
    tune.write(out, "validate", result, paper.validate_page(data, tau, verdicts))
    study_view.validated(out / "validate.rrd", data, verdicts)
    if given.json:
        print(json.dumps(result))
    else:
        _show(paper.table6(verdicts), result, out)
    return 0


def _show(table6: tuple[list[str], list[list[str]]], result: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    head, rows = table6
    tau = result["tau_m_J"]
    table = Table(*head, title=f"{result['dataset']}: Table 6 with tau = {tau['value']:.4g} m/J, m/s",
                  title_justify="left")
    for row in rows:
        table.add_row(*row)
    console = Console()
    for warning in result["warnings"]:
        console.print(f"warning: {warning}", highlight=False)
    console.print(table)
    for name, error in result["errors"].items():
        console.print(f"{name:8} mean absolute error: mean sliding {error['mean_1_m_s']:.3f} m/s, standard "
                      f"deviation {error['std_1_m_s']:.3f} m/s (wheelset 1); rms of f "
                      f"{error['adhesion_rmse']:.4f}", highlight=False)
    console.print(f"report: {out / 'validate.html'}, {out / 'validate.rrd'}", highlight=False)


def _velim(given: argparse.Namespace) -> int:
    from rollerrig.realtime.studies import velim

    found = velim.settings()
    show_velim(found, given.json, given.out)
    return 0


def show_velim(found: dict[str, float], as_json: bool, out: Path | None) -> None:
    """Run the six stops under what was found on group A, and print Table 6, ours beside the paper's."""
    from rollerrig.realtime.studies import velim

    ours = velim.table6(found, lambda text: print(text, file=sys.stderr, flush=True))
    result = velim_json(found, ours)
    if out:
        out.mkdir(parents=True, exist_ok=True)
        (out / "velim.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    if as_json:
        print(json.dumps(result))
    else:
        _show_velim(found, ours, result)


def velim_json(found: dict[str, float], ours: dict[str, Any]) -> dict[str, Any]:
    """What was fitted, what was predicted, and how far off it is."""
    from rollerrig.realtime.studies import velim

    return {
        "fitted_on_group_a": found, "predicted_mu_cd_group_b": velim.contaminant(found, "b1"),
        "stops": {test: {"sliding_mean_m_s": one.mean_m_s.tolist(),
                         "sliding_std_m_s": one.deviation_m_s.tolist(), "stop_time_s": one.stop_time_s,
                         "stop_distance_m": one.stop_distance_m, "longest_lock_s": one.longest_lock_s}
                  for test, one in ours.items()},
        "group_a_left_over_rms_m_s": velim.left_over(ours), "group_b_mean_absolute_error": velim.errors(ours),
        "group_b_bounds": {bound.name: bound.error_m_s for bound in velim.bounds()},
    }


def _show_velim(found: dict[str, float], ours: dict[str, Any], result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    from rollerrig.realtime.studies import velim

    off = result["group_b_mean_absolute_error"]
    table = Table("m/s", *(test.upper() for test in velim.TESTS), title="Table 6", title_justify="left")
    for title, values in velim.rows_for_table(ours):
        table.add_row(title, *values)
    console = Console(highlight=False)
    console.print(table)
    console.print("fitted on group A (A1 to A3): " + ", ".join(f"{k} {v:.4g}" for k, v in found.items())
                  + f"; left over there: {result['group_a_left_over_rms_m_s']:.2f} m/s rms")
    console.print(f"predicted: group B, with Table 5's speeds alone and mu_cd = "
                  f"{result['predicted_mu_cd_group_b']:.4g}; Table 4 and tau as printed, wheels on the track")
    console.print(f"group B, mean absolute error against measured: mean {off['mean_m_s']:.2f} (paper's model "
                  f"{off['paper_mean_m_s']:.2f}), deviation {off['deviation_m_s']:.2f} (paper's model "
                  f"{off['paper_deviation_m_s']:.2f}) m/s")
    limits = Table("found on group A's measured means, as a function of initial speed alone", "B1", "B2",
                   "B3", "error", title="what can be predicted of group B's mean sliding, m/s",
                   title_justify="left")
    for bound in velim.bounds():
        limits.add_row(bound.name, *(f"{x:.2f}" for x in bound.predicted_m_s), f"{bound.error_m_s:.2f}")
    limits.add_row("measured", *(f"{velim.MEASURED_MEAN[test]:.2f}" for test in velim.GROUP_B), "")
    console.print(limits)
    console.print("E1 needs the recordings, which are not public; it is printed by "
                  "'rollerrig validate DATASET' for data at hand")
