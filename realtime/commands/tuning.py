"""`rollerrig tune` and `rollerrig validate`: what the paper does with measured runs.

`tune` finds tau of the recovery (or the parameters of Polach's creep curve) on the tuning runs,
with intervals. `validate` makes Table 6 on runs that were never fitted. Two names are no datasets
but studies of the project, which need a clone: `velim` is the paper's six stops in closed loop, and
`sanding` compares the law of sand with measured stops.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.commands import clone, output, study

if TYPE_CHECKING:
    from rollerrig.rig.identify.data.runs import Dataset
    from rollerrig.rig.identify.paper.tuning import Interval, Tuned

VELIM = "velim"
SANDING = "sanding"


def tune_arguments(parser: argparse.ArgumentParser) -> None:
    _arguments(
        parser,
        "tune",
        "'velim' finds what the paper does not print, on its group A (needs a clone)",
    )
    parser.add_argument(
        "--synthetic",
        action="store_true",
        help="with 'velim': write the synthetic dataset of the six stops to --out; tune nothing",
    )


def validate_arguments(parser: argparse.ArgumentParser) -> None:
    _arguments(
        parser,
        "validate",
        "'velim' runs the paper's six stops in closed loop, and 'sanding' compares the law of sand "
        "with measured stops (both need a clone)",
    )
    parser.add_argument(
        "--tau",
        type=float,
        metavar="m/J",
        help="recovery to judge (default: tuned on the tuning runs of the dataset); run folders "
        "need it",
    )


def _arguments(parser: argparse.ArgumentParser, verb: str, studies: str) -> None:
    parser.add_argument(
        "dataset",
        nargs="+",
        help=f"folder of a dataset, name of a packaged one, or run folders; {studies}",
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
        return clone.load("paper.commands", "rollerrig tune velim").tune_velim(given)

    with study.no_folder_if_refused(given.dataset, given.out, "tune"):
        data, out = study.open_dataset(given.dataset, given.out, "tune")
        if data.kind == "creep_curve":
            return _tune_creep_curve(given, data, out)
        return _tune_recovery(given, data, out)


def _tune_creep_curve(given: argparse.Namespace, data: "Dataset", out: Path) -> int:
    """Fit Polach's parameters to a creep curve, and report them."""
    from rollerrig.realtime.reports.creep_curve import tuned
    from rollerrig.rig.identify.creep_curves import judgement
    from rollerrig.rig.identify.paper import polach_fit

    fitted = polach_fit.fit(data, given.seed)
    report = tuned.tune_report(data, fitted, judgement.without_law(data, given.seed))
    return study.publish(given, out, "tune", report, has_recording=False)


def _tune_recovery(given: argparse.Namespace, data: "Dataset", out: Path) -> int:
    """Find tau on braking runs; write the report, and the model that `rollerrig run` loads."""
    from rollerrig.realtime.reports import tuning as report
    from rollerrig.realtime.telemetry import study_view

    tuned = _tuned(data, given.seed)
    study_view.tuned(out / "tune.rrd", data, tuned)
    return study.publish(given, out, "tune", report.tune_report(data, tuned))


def validate(given: argparse.Namespace) -> int:
    if given.dataset == [SANDING]:
        return clone.load("paper.commands", "rollerrig validate sanding").validate_sanding(given)
    if given.dataset == [VELIM]:
        return clone.load("paper.commands", "rollerrig validate velim").validate_velim(given)

    if given.tau is not None and not 0.0 <= given.tau <= 1.0:
        raise ConfigError(
            f"--tau {given.tau:g} m/J is out of range; allowed are 0 to 1, and the paper has 1.9e-4"
        )
    with study.no_folder_if_refused(given.dataset, given.out, "validate"):
        data, out = study.open_dataset(given.dataset, given.out, "validate")
        if data.kind != "braking_runs":
            raise ConfigError(
                f"{given.dataset[0]}: a {data.kind} has no runs and cannot be validated; "
                "use rollerrig tune"
            )
        return _validate_runs(given, data, out)


def _validate_runs(given: argparse.Namespace, data: "Dataset", out: Path) -> int:
    """Predict the runs that were not fitted, with and without recovery, and report Table 6."""
    from rollerrig.realtime.reports import tuning as report
    from rollerrig.realtime.telemetry import study_view
    from rollerrig.rig.identify.paper import validation

    tau = _recovery(given, data)
    # with a tau from elsewhere no run was fitted, so the tuning runs can be judged, too
    group = "validate" if data.group("validate") or given.tau is None else "tune"
    verdicts = validation.validate(data, tau.value, group)
    study_view.validated(out / "validate.rrd", data, verdicts)
    return study.publish(given, out, "validate", report.validate_report(data, tau, verdicts))


def _recovery(given: argparse.Namespace, data: "Dataset") -> "Interval":
    """Return tau of the command line, or tune it on the tuning runs."""
    from rollerrig.rig.identify.paper import tuning

    if given.tau is not None:
        return tuning.Interval(given.tau, given.tau, given.tau)
    return _tuned(data, given.seed).tau_m_J


def _tuned(data: "Dataset", seed: int) -> "Tuned":
    from rollerrig.rig.identify.paper import tuning

    with output.report_progress(lambda: f"tuning on {data.name}"):
        return tuning.tune(data, seed)
