"""`rollerrig explain`: what the simulation gets wrong, why, the extended model, the measured gain."""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

# a replay ends there: creepage grows beyond all bounds as the speed falls to nothing
SLOWEST_M_S = 4.0


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", nargs="+",
                        help="folder of a dataset, name of a packaged one, or folders of runs")
    parser.add_argument("--validate", nargs="+", type=Path, default=[], metavar="RUN",
                        help="folders of runs that are never fitted, only judged (default: the last "
                        "third of the runs)")
    parser.add_argument("--out", type=Path, metavar="DIR",
                        help="folder of the report (default: reports/explain_NAME)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the clean sets (default: 0)")
    parser.add_argument("--next", type=int, default=0, metavar="N", dest="more",
                        help="propose the N most informative further stops")


def call(given: argparse.Namespace) -> int:
    from rich.console import Console

    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.paper import creep_curve

    data, out = _opened(given)
    if data.kind == "creep_curve":
        from rollerrig.realtime.reports import paper
        from rollerrig.rig.identify.paper import polach_fit

        report = creep_curve.as_json(data, given.seed)
        lines = creep_curve.story(report)
        html = paper.polach_page(data, polach_fit.fit(data, given.seed))
        extended = f"# {data.name}: nothing that a scenario could load\n"
        study_view.creep_points(out / "report.rrd", data)
    else:
        report, lines, html, extended = _braking(data, out, given)
    (out / "report.json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    (out / "report.html").write_text(html, encoding="utf-8")
    (out / "extended.toml").write_text(extended, encoding="utf-8")
    if given.json:
        print(json.dumps(report))
        return 0
    console = Console()
    console.print(f"{report['verdict']}: {data.name}", style="bold", highlight=False)
    for line in lines:
        console.print(line, highlight=False, markup=False)
    console.print(f"report: {out / 'report.html'}, {out / 'report.rrd'}; model: "
                  f"{out / 'extended.toml'}", highlight=False)
    return 0


def _opened(given: argparse.Namespace) -> tuple[Any, Path]:
    """The dataset of the command line, and the folder of its report (made)."""
    from rollerrig.configs.errors import ConfigError
    from rollerrig.realtime.studies import run_dataset, run_sensors
    from rollerrig.realtime.verbs import paper
    from rollerrig.rig.identify.data import dataset

    runs = [Path(name) for name in given.dataset]
    if not all((run / "scenario.toml").is_file() for run in runs):
        if given.validate:
            raise ConfigError(f"--validate {given.validate[0]}: {given.dataset[0]} is no folder of a run; "
                              "a dataset says in its dataset.toml which runs validate")
        data, out = paper.opened(given.dataset, given.out, "explain")
        return data, out
    out = given.out or Path("reports") / f"explain_{runs[0].resolve().name}"
    held = list(given.validate)
    if not held:
        kept = len(runs) - len(runs) // 3
        runs, held = runs[:kept], runs[kept:]
    made = run_dataset.from_folders(runs, out / "dataset", held, run_sensors.NOISE, SLOWEST_M_S)
    named = ", ".join(run.resolve().name for run in (*runs, *held))
    return dataset.load(made)._replace(name=named), out


def _braking(data: Any, out: Path, given: argparse.Namespace) -> tuple[Any, ...]:
    from rich.console import Console
    from rich.progress import Progress

    from rollerrig.realtime.reports import explain as report
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.decide import explain, extension

    with Progress(console=Console(stderr=True), transient=True) as bar:
        tasks: dict[str, Any] = {}

        def progress(title: str, share: float) -> None:
            if title not in tasks or share < 0.03:
                tasks[title] = bar.add_task(title, total=1.0)
            bar.update(tasks[title], completed=share)

        account = explain.braking_runs(data, given.seed, progress)
        found = report.as_json(account)
        lines = report.story(account) + _further(account, found, out, given.more, progress)
    study_view.explained(out / "report.rrd", data.name, report.courses(account))
    return found, lines, report.page(account, found), extension.toml(account)


def _further(account: Any, found: dict[str, Any], out: Path, count: int,
             progress: Callable[[str, float], None]) -> list[str]:
    """Write the separating tests of causes and the proposed stops as sequences; names them in `found`."""
    import tomli_w

    from rollerrig.rig.identify.next import planning

    unclear = [k for k, named in enumerate(account.causes) if named.confusable]
    if not (unclear or count):
        return []
    on = planning.ground(account)
    lib = planning.library(on, planning.surviving(account), progress)
    for k in unclear:
        named = account.causes[k]
        for test in planning.propose(lib, 1, (named.finding.name, *named.confusable)):
            file = out / ("separating_test.toml" if k == 0 else f"separating_test_{k + 1}.toml")
            file.write_text(tomli_w.dumps(planning.sequence(test, on)), encoding="utf-8")
            found["causes"][k]["separating_test"] = file.name
    proposed = planning.propose(lib, count)
    files = [out / f"next_{k}.toml" for k in range(1, len(proposed) + 1)]
    for file, test in zip(files, proposed, strict=True):
        file.write_text(tomli_w.dumps(planning.sequence(test, on)), encoding="utf-8")
    found["next"] = planning.as_json(proposed, [file.name for file in files])
    return [f"Next: {test.stop.title}; {test.reason}: rollerrig sequence {file}"
            for file, test in zip(files, proposed, strict=True)]
