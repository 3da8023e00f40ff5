"""What the study commands share: `tune`, `validate`, `explain` and `discover` open a dataset and
write a report.
"""

import argparse
import contextlib
import json
import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.configs.output_files import make_folder, write_text, writing
from rollerrig.configs.vehicle import TRAIN
from rollerrig.realtime.commands import output
from rollerrig.realtime.record import run_folder

if TYPE_CHECKING:
    from rollerrig.realtime.reports.study import StudyReport
    from rollerrig.rig.identify.data.runs import Dataset

# run folders are used down to this speed: creepage grows without bound as the speed falls to 0
SLOWEST_M_S = 4.0
# of the run folders, one in so many is never fitted unless --validate names others
RUNS_FOR_ONE_HELD_OUT = 3
# subfolder of a report for the dataset that is made of run folders
DATASET_OF_RUNS = "dataset"


def open_dataset(
    names: list[str],
    out: Path | None,
    verb: str,
    dataset_of_runs: "Callable[[list[Path], Path], Dataset] | None" = None,
) -> "tuple[Dataset, Path]":
    """Return the dataset of the command line and the folder of its report, which is created.

    `names` is one dataset (a folder or a packaged name), or one or several run folders. Run folders
    become a dataset in the subfolder `dataset` of the report; `dataset_of_runs(runs, folder)` makes
    it, by default with all runs in it. Raises ConfigError where several names are not all runs.
    """
    from rollerrig.rig.identify.data import dataset

    folder = report_folder(names, out, verb)
    are_runs = [(Path(name) / "scenario.toml").is_file() for name in names]

    if all(are_runs):
        runs = [Path(name) for name in names]
        for run in runs:
            check_alone(run, verb)
        with writing(folder):
            dataset_folder = make_folder(folder, DATASET_OF_RUNS)
        if dataset_of_runs is not None:
            return dataset_of_runs(runs, dataset_folder), folder
        from rollerrig.realtime.datasets import run_dataset

        return dataset.load(run_dataset.from_folders(runs, dataset_folder)), folder

    if len(names) > 1:
        raise ConfigError(
            f"{', '.join(names)}: several names must all be run folders; give one dataset, or only run folders"
        )
    return dataset.load(names[0]), folder


def check_alone(run: Path, verb: str) -> None:
    """Raise ConfigError for the run of a train, or of a car in it.

    Couplers push and pull a car, and no cause stands for them: they would be taken for resistance
    or brake force.
    """
    of_run = run / run_folder.SCENARIO
    of_parent = run.resolve().parent / run_folder.SCENARIO
    is_car = run.resolve().name.startswith("car_") and of_parent.is_file()
    car = run
    if TRAIN in store.parse(of_run, within=run):
        what, car = "the run of a train", run / "car_1"
    elif is_car and TRAIN in store.parse(of_parent, within=of_parent.parent):
        what = "a car of a train"
    else:
        return
    scenario = shlex.quote(str(car / run_folder.SCENARIO))
    raise ConfigError(
        f"{run} is {what}: couplers push and pull its cars, and {verb} would take their forces for "
        f"resistance or brake force; give runs of the car alone: rollerrig run {scenario} --pacing free"
    )


def dataset_of_runs(runs: list[Path], validate: list[Path], folder: Path) -> "Dataset":
    """Write and return a dataset of run folders; without `validate` the last third validates."""
    from rollerrig.realtime.datasets import run_dataset, run_sensors
    from rollerrig.rig.identify.data import dataset

    fitted = runs
    held_out = validate
    if not validate:
        first_held_out = len(runs) - len(runs) // RUNS_FOR_ONE_HELD_OUT
        fitted = runs[:first_held_out]
        held_out = runs[first_held_out:]
    written = run_dataset.from_folders(fitted, folder, held_out, run_sensors.NOISE, SLOWEST_M_S)
    name = ", ".join(run.resolve().name for run in (*fitted, *held_out))
    return dataset.load(written)._replace(name=name)


def report_folder(names: list[str], out: Path | None, verb: str) -> Path:
    """Return the folder of a report: `out`, else reports/VERB_NAME. The folder is created."""
    folder = _folder_of(names, out, verb)
    with writing(folder):
        make_folder(folder)
    return folder


def _folder_of(names: list[str], out: Path | None, verb: str) -> Path:
    return out or Path("reports") / f"{verb}_{Path(names[0]).resolve().name}"


@contextlib.contextmanager
def no_folder_if_refused(names: list[str], out: Path | None, verb: str) -> Iterator[None]:
    """Remove the folders that this command has made if the block raises RollerrigError.

    These are the folder of the report, the dataset of runs in it, and folders above it that are
    empty. A folder that was there before stays, with what a user has in it.
    """
    folder = _folder_of(names, out, verb)
    made = [path for path in (folder / DATASET_OF_RUNS, folder) if not path.exists()]
    made_above = [path for path in folder.parents if not path.exists()]
    try:
        yield
    except RollerrigError:
        for path in made:
            shutil.rmtree(path, ignore_errors=True)
        for path in made_above:
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


def publish(
    given: argparse.Namespace,
    folder: Path,
    name: str,
    report: "StudyReport",
    has_recording: bool = True,
) -> int:
    """Write the files of a report and print it; return the exit status.

    The files are NAME.json, NAME.html, and the model. The caller writes NAME.rrd, which is only
    listed here.
    """
    page = folder / f"{name}.html"
    data = json.dumps(report.result, indent=2) + "\n"
    with writing(folder):
        write_text(page, report.page)
        write_text(folder / f"{name}.json", data)
        if report.model is not None:
            write_text(folder / report.model.file_name, report.model.toml)

    files = f"report: {page}"
    if has_recording:
        files += f", {folder / name}.rrd"
    if report.model is not None:
        files += f"; model: {folder / report.model.file_name}"
    return output.show(given, report.result, *report.summary, files)
