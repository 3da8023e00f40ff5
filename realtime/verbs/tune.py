"""`rollerrig tune`: recovery tau (or Polach's parameters) from measured data, with intervals."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

VELIM = "velim"


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", nargs="+", help="folder of a dataset, name of a packaged one, folders "
                        "of runs, or 'velim': find what the paper does not print on its group A")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the report (default: "
                        "reports/tune_NAME)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the bootstrap (default: 0)")
    parser.add_argument("--synthetic", action="store_true", help="with 'velim': make the synthetic "
                        "dataset of the six stops in --out, and tune nothing")


def call(given: argparse.Namespace) -> int:
    if given.dataset == [VELIM]:
        return _velim(given)
    from rollerrig.realtime.reports import paper
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.paper import polach_fit, tuning

    data, out = opened(given.dataset, given.out, "tune")
    if data.kind == "creep_curve":
        fitted = polach_fit.fit(data, given.seed)
        result = paper.polach_json(data, fitted)
        write(out, "tune", result, paper.polach_page(data, fitted))
        _show_curve(result, out) if not given.json else print(json.dumps(result))
        return 0
    found = tuning.tune(data, given.seed)
    result = paper.tune_json(data, found)
    write(out, "tune", result, paper.tune_page(data, found))
    study_view.tuned(out / "tune.rrd", data, found)
    (out / "tuned.toml").write_text(
        f"# tuned on {data.name} by rollerrig tune; load it with: rollerrig run ... --model\n"
        f"[adhesion]\ntau_m_J = {found.tau_m_J.value!r}\n", encoding="utf-8")
    print(json.dumps(result)) if given.json else _show(result, out)
    return 0


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


def write(out: Path, verb: str, result: dict[str, Any], page: str) -> None:
    """The report's files."""
    (out / f"{verb}.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    (out / f"{verb}.html").write_text(page, encoding="utf-8")


def _range(value: dict[str, Any]) -> str:
    low, high = value["ci95"]
    return f"{value['value']:.4g}  ({low:.4g} to {high:.4g})"


def _show(result: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("", "value (95 %)", title=f"tuned on {result['dataset']}", title_justify="left")
    table.add_row("tau, m/J", _range(result["tau_m_J"]))
    table.add_row("tau, the paper's form of eq. 21", f"{result['tau_paper_form_m_J']:.4g}")
    for run, value in result["mu_cd"].items():
        table.add_row(f"mu_cd of {run}", _range(value))
    for name, value in result["adhesion_rmse"].items():
        table.add_row(f"rms error of f, {name}", f"{value:.5f}")
    console = Console()
    for warning in result["warnings"]:
        console.print(f"warning: {warning}", highlight=False)
    console.print(table)
    console.print(f"report: {out / 'tune.html'}, {out / 'tune.rrd'}; model: {out / 'tuned.toml'}",
                  highlight=False)


def _show_curve(result: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("Polach", "value (95 %)", title=f"fitted to {result['dataset']}", title_justify="left")
    for name, value in result["parameters"].items():
        table.add_row(name, _range(value))
    table.add_row("rms error", f"{result['rms']:.4f}")
    table.add_row("rms error, friction does not fall", f"{result['rms_without_falling_friction']:.4f}")
    table.add_row("  the same, k_S <= k_A",
                  f"{result['rms_without_falling_friction_k_s_below_k_a']:.4f}")
    table.add_row("scatter of the points", f"{result['scatter_floor']:.4f}")
    for name, value in result["mean_error_of_recommended_sets"].items():
        table.add_row(f"mean error of Polach's {name} set", f"{value:+.3f}")
    console = Console()
    console.print(table)
    console.print(f"report: {out / 'tune.html'}", highlight=False)


def _velim(given: argparse.Namespace) -> int:
    import tomli_w

    from rollerrig.realtime.studies import run_dataset, velim
    from rollerrig.realtime.verbs import validate

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    if given.synthetic:
        folder = run_dataset.velim_synthetic(given.out or Path("velim_synthetic"), given.seed + 1)
        print(json.dumps({"dataset": str(folder)}) if given.json else f"synthetic dataset: {folder}")
        return 0
    found = velim.calibrate(say)
    out = given.out or Path("reports/tune_velim")
    out.mkdir(parents=True, exist_ok=True)
    (out / "velim.toml").write_text("# found on group A of Table 6\n" + tomli_w.dumps(found), encoding="utf-8")
    validate.show_velim(found, given.json, out)
    if not given.json:
        print(f"written to {out / 'velim.toml'}; it takes effect as configs/velim.toml")
    return 0
