"""`rollerrig explain`: what the simulation gets wrong, why, the extended model, the measured gain."""

import argparse
import json
from pathlib import Path
from typing import Any


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", nargs="+",
                        help="folder of a dataset, name of a packaged one, or folders of runs")
    parser.add_argument("--out", type=Path, metavar="DIR",
                        help="folder of the report (default: reports/explain_NAME)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the clean sets (default: 0)")
    parser.add_argument("--next", type=int, default=0, metavar="N", dest="more",
                        help="propose the N most informative further stops")


def call(given: argparse.Namespace) -> int:
    from rich.console import Console

    from rollerrig.realtime import study_view
    from rollerrig.realtime.verb_tune import opened
    from rollerrig.rig.identify import creep_account

    data, out = opened(given.dataset, given.out, "explain")
    if data.kind == "creep_curve":
        from rollerrig.rig.identify import paper_report, polach_fit

        report = creep_account.as_json(data, given.seed)
        lines = creep_account.story(report)
        html = paper_report.polach_page(data, polach_fit.fit(data, given.seed))
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


def _braking(data: Any, out: Path, given: argparse.Namespace) -> tuple[Any, ...]:
    from rich.console import Console
    from rich.progress import Progress

    from rollerrig.realtime import study_view
    from rollerrig.rig.identify import explain, extension, planning, report

    with Progress(console=Console(stderr=True), transient=True) as bar:
        tasks: dict[str, Any] = {}

        def progress(title: str, share: float) -> None:
            if title not in tasks or share < 0.03:
                tasks[title] = bar.add_task(title, total=1.0)
            bar.update(tasks[title], completed=share)

        account = explain.braking_runs(data, given.seed, progress)
    told = report.as_json(account)
    for cause in told["causes"]:
        if cause["separating_test"]:
            (out / "separating_test.toml").write_text(cause["separating_test"], encoding="utf-8")
    names = {n.cause.name for n in account.causes} | {
        other for n in account.causes for other in n.confusable}
    for k, stop in enumerate(planning.stops(names, given.more), start=1):
        (out / f"next_{k}.toml").write_text(planning.scenario(stop), encoding="utf-8")
    lines = report.story(account)
    lines += [f"Next {k}: {stop.reason}: rollerrig run {out / f'next_{k}.toml'}"
              for k, stop in enumerate(planning.stops(names, given.more), start=1)]
    study_view.explained(out / "report.rrd", report.courses(account))
    return told, lines, report.page(account, told), extension.toml(account)
