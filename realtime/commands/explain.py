"""`rollerrig explain`: what the simulation gets wrong, why, and what an extended model gains."""

import argparse
import contextlib
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import write_text
from rollerrig.realtime.commands import output, study

if TYPE_CHECKING:
    from rollerrig.rig.identify.data.runs import Dataset
    from rollerrig.rig.identify.decide.decision import Diagnosis

Progress = Callable[[str, float], None]

# kernels that this process compiles at its first start; the messages need the number
_KERNELS = 87


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "dataset",
        nargs="+",
        help="folder of a dataset, name of a packaged dataset, or folders of runs",
    )
    parser.add_argument(
        "--validate",
        nargs="+",
        type=Path,
        default=[],
        metavar="RUN",
        help="folders of runs that are never fitted, only judged "
        "(default: the last third of the runs)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of the report (default: reports/explain_NAME)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the null simulations (default: 0)"
    )
    parser.add_argument(
        "--next",
        type=int,
        default=0,
        metavar="N",
        dest="more",
        help="propose the N most informative further stops",
    )


def call(given: argparse.Namespace) -> int:
    with study.no_folder_if_refused(given.dataset, given.out, "explain"):
        return _explain(given)


def _explain(given: argparse.Namespace) -> int:
    if _is_recorder(given.dataset):
        return _explain_recorder(given)
    data, out = _open_dataset(given)
    if data.kind == "creep_curve":
        return _explain_creep_curve(given, data, out)
    return _explain_braking_runs(given, data, out)


# --- the three kinds of data ---


def _explain_braking_runs(given: argparse.Namespace, data: "Dataset", out: Path) -> int:
    from rollerrig.rig.compiled import compile_progress
    from rollerrig.rig.identify.decide import decision

    compile_progress.expect(_KERNELS)
    with progress_bar() as progress:
        diagnosis = decision.explain_braking_runs(data, given.seed, progress)
        return write_and_show(given, diagnosis, out, progress, stops=given.more)


def _explain_creep_curve(given: argparse.Namespace, data: "Dataset", out: Path) -> int:
    from rollerrig.realtime.reports.creep_curve import explained
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.creep_curves import judgement

    judged = judgement.judge(data, given.seed)
    study_view.creep_points(out / "report.rrd", data)
    return study.publish(given, out, "report", explained.explain_report(data, judged))


def _is_recorder(names: list[str]) -> bool:
    """Return whether the data are what a train records."""
    from rollerrig.rig.identify.data import dataset

    is_run = (Path(names[0]) / "scenario.toml").is_file()
    if len(names) > 1 or is_run:
        return False
    head = dataset.parse(dataset.find(names[0]) / "dataset.toml")
    return head.get("kind") == "recorder"


def _explain_recorder(given: argparse.Namespace) -> int:
    from rollerrig.realtime.reports import recorder as report
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.train_recorder import recording, verdict

    data = recording.load(given.dataset[0])
    out = study.report_folder(given.dataset, given.out, "explain")
    with output.report_progress(lambda: f"explaining {data.name}"):
        account = verdict.explain(data)
    study_view.recorded(
        out / "report.rrd", data.name, report.courses(account), report.remarks(account)
    )
    return study.publish(given, out, "report", report.report(account))


# --- input ---


def _open_dataset(given: argparse.Namespace) -> "tuple[Dataset, Path]":
    """Return the dataset of the command line, and the folder of its report, which is created."""
    are_runs = all((Path(name) / "scenario.toml").is_file() for name in given.dataset)
    if given.validate and not are_runs:
        raise ConfigError(
            f"--validate {given.validate[0]}: {given.dataset[0]} is not a run folder; give --validate "
            "with run folders only. A dataset names its runs to validate in its dataset.toml"
        )

    for run in given.validate:
        study.check_alone(run, "explain")

    def dataset_of_runs(runs: list[Path], folder: Path) -> "Dataset":
        return study.dataset_of_runs(runs, given.validate, folder)

    return study.open_dataset(given.dataset, given.out, "explain", dataset_of_runs)


# --- output ---


@contextlib.contextmanager
def progress_bar() -> Iterator[Progress]:
    """Show progress: yields a function of the title of a stage and its share done, 0 to 1.

    How many stages follow depends on what they find. A stage that is done is shown as done, and not
    as 100 %, which would look like the end of the command.
    """
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    state = "reading the data"
    bar = Bar(
        # a title is no markup
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[state]}", markup=False),
        console=output.console(error=True),
        transient=True,
    )
    with bar, output.report_progress(lambda: state):
        stages: dict[str, Any] = {}
        count = 0

        def progress(title: str, share: float) -> None:
            nonlocal state, count
            if title not in stages or bar.tasks[stages[title]].completed >= share:
                # a stage that begins again is a further stage
                count += 1
                stages[title] = bar.add_task(f"stage {count}, {title}", total=1.0, state="")
            done = "done" if share >= 1.0 else f"{int(100.0 * share)} %"
            bar.update(stages[title], completed=share, state=done)
            state = f"stage {count}, {title}: {done}"
            if share >= 1.0:
                state += ", evaluating it"

        yield progress


def write_and_show(
    given: argparse.Namespace,
    diagnosis: "Diagnosis",
    out: Path,
    progress: Progress,
    stops: int = 0,
    **more_entries: Any,
) -> int:
    """Write the report of a diagnosis and show it. Returns the exit status.

    `stops` further stops are proposed. `more_entries` are added to report.json.
    """
    from rollerrig.realtime.reports import cause_report, cause_sentences, extended_model
    from rollerrig.realtime.reports.study import Model, StudyReport, verdict_and_sentences
    from rollerrig.realtime.telemetry import study_view

    report = cause_report.as_json(diagnosis) | more_entries
    lines = cause_sentences.story(diagnosis)
    lines += _write_further_stops(diagnosis, report, out, stops, progress)
    where, causes = cause_report.panels(diagnosis, report)
    study_view.explained(
        out / "report.rrd",
        diagnosis.data.name,
        cause_report.as_markdown(diagnosis, report),
        where,
        causes,
        cause_report.adhesion_courses(diagnosis),
    )
    return study.publish(
        given,
        out,
        "report",
        StudyReport(
            result=report,
            page=cause_report.page(diagnosis, report),
            summary=verdict_and_sentences(report["verdict"], diagnosis.data.name, lines),
            model=Model("extended.toml", extended_model.toml(diagnosis)),
        ),
    )


def _write_further_stops(
    diagnosis: "Diagnosis", report: dict[str, Any], out: Path, count: int, progress: Progress
) -> list[str]:
    """Write separating tests and proposed stops as sequences; return lines about the stops.

    Their names are added to the report.
    """
    import tomli_w

    from rollerrig.realtime.reports import proposed_stops
    from rollerrig.rig.identify.next_stops import planning

    unclear = [k for k, identified in enumerate(diagnosis.causes) if identified.confusable]
    if not (unclear or count):
        return []
    fitted = planning.FittedData(diagnosis.data, diagnosis.design, diagnosis.final)
    library = planning.library(fitted, planning.surviving(diagnosis), progress)

    def write(name: str, proposal: planning.Proposal) -> Path:
        sequence = proposed_stops.sequence(proposal, fitted)
        write_text(out / name, tomli_w.dumps(sequence))
        return out / name

    for k in unclear:
        identified = diagnosis.causes[k]
        names = (identified.score_test.name, *identified.confusable)
        file_name = "separating_test.toml" if k == 0 else f"separating_test_{k + 1}.toml"
        for proposal in planning.propose(library, 1, names):
            file = write(file_name, proposal)
            report["causes"][k]["separating_test"] = file.name

    proposals = planning.propose(library, count)
    files = [write(f"next_{k}.toml", proposal) for k, proposal in enumerate(proposals, start=1)]
    report["next"] = proposed_stops.as_json(proposals, [file.name for file in files])
    lines = []
    for file, proposal in zip(files, proposals, strict=True):
        title = proposed_stops.title(proposal.stop)
        reason = proposed_stops.reason(proposal)
        command = shlex.join(["rollerrig", "sequence", str(file)])
        lines.append(f"Next: {title}; {reason}: {command}")
    return lines
