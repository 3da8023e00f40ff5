"""`rollerrig explain`: what the simulation gets wrong, why, the extended model, the measured gain."""

import argparse
import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import output, study

# a replay ends there: creepage grows beyond all bounds as the speed falls to nothing
SLOWEST_M_S = 4.0


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "dataset", nargs="+", help="folder of a dataset, name of a packaged one, or folders of runs"
    )
    parser.add_argument(
        "--validate",
        nargs="+",
        type=Path,
        default=[],
        metavar="RUN",
        help="folders of runs that are never fitted, only judged (default: the last third of the runs)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of the report (default: reports/explain_NAME)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the clean sets (default: 0)")
    parser.add_argument(
        "--next",
        type=int,
        default=0,
        metavar="N",
        dest="more",
        help="propose the N most informative further stops",
    )


def call(given: argparse.Namespace) -> int:
    if _is_recorder(given.dataset):
        return _recorder(given)
    data, out = _opened(given)
    if data.kind == "creep_curve":
        from rollerrig.realtime.reports import tuning as page
        from rollerrig.realtime.telemetry import study_view
        from rollerrig.rig.identify.paper import polach_fit

        fitted = polach_fit.fit(data, given.seed)
        report = polach_fit.as_json(data, fitted)
        study_view.creep_points(out / "report.rrd", data)
        return _show(
            given,
            out,
            data.name,
            report,
            polach_fit.story(report),
            page.polach_page(data, fitted),
            f"# {data.name}: nothing that a scenario could load\n",
        )
    from rollerrig.rig.identify.decide import decision

    with progress_bar() as progress:
        return told(
            given,
            decision.explain_braking_runs(data, given.seed, progress),
            out,
            progress,
            given.more,
        )


def _show(
    given: argparse.Namespace,
    out: Path,
    name: str,
    report: dict[str, Any],
    lines: list[str],
    html: str,
    extended: str,
) -> int:
    from rich.text import Text

    study.write_report(out, "report", report, html)
    (out / "extended.toml").write_text(extended, encoding="utf-8")
    return output.show(
        given,
        report,
        Text(f"{report['verdict']}: {name}", "bold"),
        *map(Text, lines),
        f"report: {out / 'report.html'}, {out / 'report.rrd'}; model: {out / 'extended.toml'}",
    )


def _is_recorder(names: list[str]) -> bool:
    from rollerrig.rig.identify.data import dataset

    if len(names) > 1 or (Path(names[0]) / "scenario.toml").is_file():
        return False
    return dataset.parse(dataset.find(names[0]) / "dataset.toml").get("kind") == "recorder"


def _recorder(given: argparse.Namespace) -> int:
    from rich.text import Text

    from rollerrig.realtime.reports import recorder as report
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.train_recorder import recording, verdict

    read = recording.load(given.dataset[0])
    out = study.report_folder(given.dataset, given.out, "explain")
    with output.progress_of(lambda: f"explaining {read.name}"):
        found = verdict.explain(read)
    told = verdict.as_json(found)
    study.write_report(out, "report", told, report.page(found))
    study_view.recorded(
        out / "report.rrd",
        read.name,
        report.courses(found),
        [(f.run, f.start_s, f"{f.name}: {f.text}") for f in (*found.findings, *found.unknown)],
    )
    return output.show(
        given,
        told,
        Text(f"{found.verdict}: {read.name}", "bold"),
        *map(Text, verdict.story(found)),
        f"report: {out / 'report.html'}, {out / 'report.rrd'}",
    )


def _opened(given: argparse.Namespace) -> tuple[Any, Path]:
    """The dataset of the command line, and the folder of its report (made)."""
    from rollerrig.realtime.datasets import run_dataset, run_sensors
    from rollerrig.rig.identify.data import dataset

    def of_runs(runs: list[Path], folder: Path) -> Any:
        kept = len(runs) if given.validate else len(runs) - len(runs) // 3
        fitted, held = runs[:kept], given.validate or runs[kept:]
        made = run_dataset.from_folders(fitted, folder, held, run_sensors.NOISE, SLOWEST_M_S)
        return dataset.load(made)._replace(
            name=", ".join(run.resolve().name for run in (*fitted, *held))
        )

    if given.validate and not all(
        (Path(name) / "scenario.toml").is_file() for name in given.dataset
    ):
        raise ConfigError(
            f"--validate {given.validate[0]}: {given.dataset[0]} is no folder of a run; a dataset says "
            "in its dataset.toml which runs validate"
        )
    return study.open_dataset(given.dataset, given.out, "explain", of_runs)


@contextlib.contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Shows how far each piece of work is, told by its title and share."""
    from rich.console import Console
    from rich.progress import Progress

    at = "reading the data"
    with (
        Progress(console=Console(stderr=True), transient=True) as bar,
        output.progress_of(lambda: at),
    ):
        tasks: dict[str, Any] = {}

        def progress(title: str, share: float) -> None:
            nonlocal at
            at = f"{title}: {share:.0%}"
            if title not in tasks or share < 0.03:
                tasks[title] = bar.add_task(title, total=1.0)
            bar.update(tasks[title], completed=share)

        yield progress


def told(
    given: argparse.Namespace,
    account: Any,
    out: Path,
    progress: Callable[[str, float], None],
    more: int = 0,
    **beside: Any,
) -> int:
    """Write the report of an account, with further stops to be proposed and what stands beside it, and show it."""
    from rollerrig.realtime.reports import cause_report as report
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.decide import extended_model

    found = report.as_json(account) | beside
    lines = report.story(account) + _further(account, found, out, more, progress)
    study_view.explained(
        out / "report.rrd",
        account.data.name,
        report.in_words(account, found),
        *report.panels(account, found),
        report.courses(account),
    )
    return _show(
        given,
        out,
        account.data.name,
        found,
        lines,
        report.page(account, found),
        extended_model.toml(account),
    )


def _further(
    account: Any,
    found: dict[str, Any],
    out: Path,
    count: int,
    progress: Callable[[str, float], None],
) -> list[str]:
    """Write the separating tests of causes and the proposed stops as sequences; names them in `found`."""
    import tomli_w

    from rollerrig.rig.identify.next_stops import planning

    unclear = [k for k, named in enumerate(account.causes) if named.confusable]
    if not (unclear or count):
        return []
    fitted = planning.FittedData(account.data, account.design, account.final)
    lib = planning.library(fitted, planning.surviving(account), progress)

    def write(name: str, test: Any) -> Path:
        (out / name).write_text(tomli_w.dumps(planning.sequence(test, fitted)), encoding="utf-8")
        return out / name

    for k in unclear:
        named = account.causes[k]
        for test in planning.propose(lib, 1, (named.finding.name, *named.confusable)):
            file = write(
                "separating_test.toml" if k == 0 else f"separating_test_{k + 1}.toml", test
            )
            found["causes"][k]["separating_test"] = file.name
    proposed = planning.propose(lib, count)
    files = [write(f"next_{k}.toml", test) for k, test in enumerate(proposed, start=1)]
    found["next"] = planning.as_json(proposed, [file.name for file in files])
    return [
        f"Next: {test.stop.title}; {test.reason}: rollerrig sequence {file}"
        for file, test in zip(files, proposed, strict=True)
    ]
