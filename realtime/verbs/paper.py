"""`rollerrig tune` and `rollerrig validate`: what the paper does with measured runs, and with its own stops.

`tune` finds tau of the recovery (or Polach's parameters) on the tuning runs, with intervals; `validate`
makes Table 6 on runs that were never fitted. The dataset `velim` is the paper's six stops in closed
loop: what it does not print is found on group A, and group B is predicted.
"""

import argparse
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

VELIM = "velim"


def tune_arguments(parser: argparse.ArgumentParser) -> None:
    _arguments(parser, "tune", "find what the paper does not print on its group A")
    parser.add_argument("--synthetic", action="store_true", help="with 'velim': make the synthetic "
                        "dataset of the six stops in --out, and tune nothing")


def validate_arguments(parser: argparse.ArgumentParser) -> None:
    _arguments(parser, "validate", "the paper's six stops in closed loop")
    parser.add_argument("--tau", type=float, metavar="m/J", help="recovery to judge (default: tuned on "
                        "the dataset's tuning runs); folders of runs need it")


def _arguments(parser: argparse.ArgumentParser, verb: str, of_velim: str) -> None:
    parser.add_argument("dataset", nargs="+", help="folder of a dataset, name of a packaged one, folders "
                        f"of runs, or 'velim': {of_velim}")
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"folder of the report (default: "
                        f"reports/{verb}_NAME)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the bootstrap (default: 0)")


def tune(given: argparse.Namespace) -> int:
    if given.dataset == [VELIM]:
        return _tune_velim(given)
    from rollerrig.realtime.reports import paper
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.paper import polach_fit, tuning

    data, out = opened(given.dataset, given.out, "tune")
    if data.kind == "creep_curve":
        fitted = polach_fit.fit(data, given.seed)
        result = paper.polach_json(data, fitted)
        _write(out, "tune", result, paper.polach_page(data, fitted))
        rows = [(name, _range(value)) for name, value in result["parameters"].items()]
        rows += [("rms error", f"{result['rms']:.4f}"),
                 ("rms error, friction does not fall", f"{result['rms_without_falling_friction']:.4f}"),
                 ("  the same, k_S <= k_A", f"{result['rms_without_falling_friction_k_s_below_k_a']:.4f}"),
                 ("scatter of the points", f"{result['scatter_floor']:.4f}")]
        rows += [(f"mean error of Polach's {name} set", f"{value:+.3f}")
                 for name, value in result["mean_error_of_recommended_sets"].items()]
        return _show(given, result, f"fitted to {result['dataset']}", ("Polach", "value (95 %)"), rows,
                     [f"report: {out / 'tune.html'}"])
    found = tuning.tune(data, given.seed)
    result = paper.tune_json(data, found)
    _write(out, "tune", result, paper.tune_page(data, found))
    study_view.tuned(out / "tune.rrd", data, found)
    (out / "tuned.toml").write_text(
        f"# tuned on {data.name} by rollerrig tune; load it with: rollerrig run ... --model\n"
        f"[adhesion]\ntau_m_J = {found.tau_m_J.value!r}\n", encoding="utf-8")
    rows = [("tau, m/J", _range(result["tau_m_J"])),
            ("tau, the paper's form of eq. 21", f"{result['tau_paper_form_m_J']:.4g}")]
    rows += [(f"mu_cd of {run}", _range(value)) for run, value in result["mu_cd"].items()]
    rows += [(f"rms error of f, {name}", f"{value:.5f}") for name, value in result["adhesion_rmse"].items()]
    return _show(given, result, f"tuned on {result['dataset']}", ("", "value (95 %)"), rows,
                 [f"report: {out / 'tune.html'}, {out / 'tune.rrd'}; model: {out / 'tuned.toml'}"])


def validate(given: argparse.Namespace) -> int:
    if given.dataset == [VELIM]:
        from rollerrig.realtime.studies import velim

        return _compare_velim(velim.settings(), given.json, given.out)
    from rollerrig.configs.errors import ConfigError
    from rollerrig.realtime.reports import paper
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.paper import tuning, validation

    if given.tau is not None and not 0.0 <= given.tau <= 1.0:
        raise ConfigError(f"--tau {given.tau:g} m/J is out of range; allowed 0 to 1, the paper has 1.9e-4")
    data, out = opened(given.dataset, given.out, "validate")
    if data.kind != "braking_runs":
        raise ConfigError(f"{given.dataset[0]}: a {data.kind} cannot be validated, it has no runs; use "
                          "rollerrig tune")
    tau = (tuning.Interval(given.tau, given.tau, given.tau) if given.tau is not None
           else tuning.tune(data, given.seed).tau_m_J)
    group = "validate" if data.group("validate") or given.tau is None else "tune"
    verdicts = validation.validate(data, tau.value, group)
    result = paper.validate_json(data, tau, verdicts)
    _write(out, "validate", result, paper.validate_page(data, tau, verdicts))
    study_view.validated(out / "validate.rrd", data, verdicts)
    errors = [f"{name:8} mean absolute error: mean sliding {error['mean_1_m_s']:.3f} m/s, standard "
              f"deviation {error['std_1_m_s']:.3f} m/s (wheelset 1); rms of f {error['adhesion_rmse']:.4f}"
              for name, error in result["errors"].items()]
    return _show(given, result, f"{result['dataset']}: Table 6 with tau = {tau.value:.4g} m/J, m/s",
                 *paper.table6(verdicts), [*errors, f"report: {out / 'validate.html'}, {out / 'validate.rrd'}"])


def opened(names: list[str], out: Path | None, verb: str) -> tuple[Any, Path]:
    """The dataset of the command line, and the folder of its report (made)."""
    from rollerrig.configs.errors import ConfigError
    from rollerrig.realtime.studies import run_dataset
    from rollerrig.rig.identify.data import dataset

    folder = out or Path("reports") / f"{verb}_{Path(names[0]).resolve().name}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror}; give another --out") from None
    runs = [Path(name) for name in names if (Path(name) / "scenario.toml").is_file()]
    if runs and len(runs) == len(names):
        return dataset.load(run_dataset.from_folders(runs, folder / "dataset")), folder
    if len(names) > 1:
        raise ConfigError(f"{', '.join(names)}: several names must all be folders of runs; give one "
                          "dataset, or only runs")
    return dataset.load(names[0]), folder


def _write(out: Path, verb: str, result: dict[str, Any], page: str) -> None:
    """The report's files."""
    (out / f"{verb}.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    (out / f"{verb}.html").write_text(page, encoding="utf-8")


def _range(value: dict[str, Any]) -> str:
    low, high = value["ci95"]
    return f"{value['value']:.4g}  ({low:.4g} to {high:.4g})"


def _show(given: argparse.Namespace, result: dict[str, Any], title: str, head: Iterable[str],
          rows: Iterable[Iterable[str]], lines: Iterable[str]) -> int:
    """Print a result as JSON, or its warnings, a table and some lines below."""
    from rich.console import Console
    from rich.table import Table

    if given.json:
        print(json.dumps(result))
        return 0
    console = Console(highlight=False)
    for warning in result.get("warnings", ()):
        console.print(f"warning: {warning}")
    table = Table(*head, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    console.print(table)
    for line in lines:
        console.print(line)
    return 0


# --- the paper's own stops ---

def _tune_velim(given: argparse.Namespace) -> int:
    import tomli_w

    from rollerrig.realtime.studies import run_dataset, velim

    if given.synthetic:
        folder = run_dataset.velim_synthetic(given.out or Path("velim_synthetic"), given.seed + 1)
        print(json.dumps({"dataset": str(folder)}) if given.json else f"synthetic dataset: {folder}")
        return 0
    found = velim.calibrate(_progress)
    out = given.out or Path("reports/tune_velim")
    out.mkdir(parents=True, exist_ok=True)
    (out / "velim.toml").write_text("# found on group A of Table 6\n" + tomli_w.dumps(found), encoding="utf-8")
    _compare_velim(found, given.json, out)
    if not given.json:
        print(f"written to {out / 'velim.toml'}; it takes effect as configs/velim.toml")
    return 0


def _progress(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _compare_velim(found: dict[str, float], as_json: bool, out: Path | None) -> int:
    """Run the six stops under what was found on group A, and print Table 6, ours beside the paper's."""
    from rollerrig.realtime.studies import velim

    ours = velim.table6(found, _progress)
    result = velim_json(found, ours)
    if out:
        out.mkdir(parents=True, exist_ok=True)
        (out / "velim.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    if as_json:
        print(json.dumps(result))
    else:
        _show_velim(found, ours, result)
    return 0


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
