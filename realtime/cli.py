"""The command `rollerrig`: its verbs, their help, and how errors become messages and a status.

Verbs take paths of files and folders and print such paths. With --json a verb prints exactly one
JSON object on standard output. Progress and messages go to standard error.

Only this file catches RollerrigError.
"""

import argparse
import contextlib
import errno
import importlib
import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Any, NamedTuple, NoReturn

from rollerrig.configs.errors import (
    ConfigError,
    InvalidRunError,
    RollerrigError,
    UnitLostError,
)
from rollerrig.configs.processes import children
from rollerrig.configs.processes.without import without
from rollerrig.configs.table import similar
from rollerrig.realtime import standard_streams
from rollerrig.realtime.commands import (
    bench,
    campaign,
    check,
    desk,
    devices,
    discover,
    explain,
    listing,
    results,
    run,
    sequence,
    tuning,
    wsp,
)
from rollerrig.realtime.commands.datasets import importing
from rollerrig.realtime.commands.evidence import brake_calculation, etcs, programme
from rollerrig.realtime.commands.shell import completion, manual

# exit statuses
PASS = 0
FAILED = 1
USAGE = 2
LATE = 3
INVALID = 4
EXIT_STATUSES = {
    PASS: "pass",
    FAILED: "a verdict failed, or a sequence could not be judged (`error`), for example because its "
    "run is not valid",
    USAGE: "the command line, a configuration or a file is wrong, the machine lacks something, or a "
    "unit or harness did not come",
    LATE: "deadlines were missed under `--strict`",
    INVALID: "a run of `rollerrig run`, `campaign` or `compare` is not valid (unit lost or silent, not "
    "stopped); or the command was interrupted",
}

# characters of a message that are printed
MESSAGE_BEGIN = 4000
MESSAGE_END = 1000


NO_MEMORY = (
    "there is not enough memory; close other programs, allow this process more (ulimit -v), or give "
    "it less to do at the same time (--workers, smaller files)"
)
# errors of the system that are no fault of the program, with their remedies
LACKS_OF_MACHINE = {
    errno.ENOSPC: "make room, or choose a folder on another disk",
    errno.EDQUOT: "make room, or choose a folder on another disk",
    errno.EFBIG: "allow larger files (ulimit -f), or choose a folder on another disk",
    errno.EROFS: "choose a folder on a disk that can be written",
    errno.EIO: "look at the messages of the system about this disk, and use another one",
    errno.ENOMEM: NO_MEMORY,
    errno.EAGAIN: "allow more processes and threads (ulimit -u)",
    errno.EMFILE: "allow more open files (ulimit -n)",
    errno.ENFILE: "close other programs, which have too many open files",
}

# environment variables that chose the vehicle of a process in earlier versions: without effect
FORMER_VARIABLES = ("ROLLERRIG_AXLES", "ROLLERRIG_EQUIPMENT")

# option of `rollerrig` for Python: errors are printed as JSON only, and messages name its arguments
FROM_PYTHON = "--from-python"


class Parser(argparse.ArgumentParser):
    """A parser whose messages suggest the word that was probably meant.

    raises: whether a wrong command line raises ConfigError instead of ending the process.
    """

    def __init__(self, *arguments: Any, raises: bool = False, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.raises = raises

    def error(self, message: str) -> NoReturn:
        """Report a wrong command line: print the usage and exit, or raise ConfigError."""
        text = message + _suggestion(message)
        if self.raises:
            raise ConfigError(text)
        super().error(text)


def _suggestion(message: str) -> str:
    """Return which choice was probably meant, as the end of a message of argparse."""
    match = re.search(r"invalid choice: '(.*)' \(choose from (.*)\)$", message)
    if not match:
        return ""
    # newer versions of Python write the choices without quotes
    choices = [name.strip(" '") for name in match[2].split(",")]
    meant = similar(match[1], choices)
    return f"; did you mean '{meant[0]}'?" if meant else ""


class Verb(NamedTuple):
    """A verb of the command line.

    name: the word after `rollerrig`.
    arguments: declares the arguments of the verb.
    call: does the work and returns the exit status.
    summary: the help in one line; it begins with a lower-case letter and has no full stop.
    example: a command line that works.
    session: lines of a shell that do a whole task, for verbs that need several commands.
    """

    name: str
    arguments: Callable[[argparse.ArgumentParser], None]
    call: Callable[[argparse.Namespace], int]
    summary: str
    example: str
    session: tuple[str, ...] = ()


VERBS = (
    Verb(
        "run",
        run.arguments,
        run.call,
        "run the bench once: brake the vehicle and record everything",
        "rollerrig run velim_a1 --pacing lockstep --out runs/a1",
    ),
    Verb(
        "wsp",
        wsp.arguments,
        wsp.call,
        "run the reference WSP unit as a separate program on a bus",
        "rollerrig wsp --bus socketcand://127.0.0.1:29536/rig0",
    ),
    Verb(
        "sequence",
        sequence.arguments,
        sequence.call,
        "play scripted tests over the buses, and write their verdicts and a report",
        "rollerrig sequence emergency_120 --out report",
    ),
    Verb(
        "programme",
        programme.arguments,
        programme.call,
        "play a test programme with one unit, and write one evidence file",
        "rollerrig programme en15595_style --out programmes/coach",
    ),
    Verb(
        "compare",
        results.compare_arguments,
        results.compare,
        "compare runs (values with tolerances, curves overlaid in Rerun), or two campaigns",
        "rollerrig compare runs/a runs/b --tolerance m_s=0.1",
    ),
    Verb(
        "export",
        results.export_arguments,
        results.export,
        "write runs as MDF4, MAT or CSV with all channels and events, or as one dataset",
        "rollerrig export runs/demo --format csv --out demo.csv",
    ),
    Verb(
        "import",
        importing.arguments,
        importing.call,
        "make a dataset of the files of a logger: propose what each column is, ask, write it",
        "rollerrig import docs/examples/import/fahrt_1.csv --out datasets/fahrten",
    ),
    Verb(
        "export-fmu",
        results.fmu_arguments,
        results.export_fmu,
        "write the rig as an FMU for other simulation programs",
        "rollerrig export-fmu velim_a1 --out rig.fmu",
    ),
    Verb(
        "campaign",
        campaign.arguments,
        campaign.call,
        "do the many runs of a plan, in processes or on a Dask cluster",
        "rollerrig campaign low_adhesion --out campaigns/soap",
        (
            "# plan",
            'echo \'scenario = "velim_a1"',
            'design = "random"',
            "runs = 40",
            "[vary]",
            '"adhesion.mu_cd" = { low = 0.03, high = 0.1 }\' > plan.toml',
            "# run",
            "rollerrig campaign plan.toml --out with_wsp",
            "# continue after an interruption: the same command",
            "rollerrig campaign plan.toml --out with_wsp",
            "# compare with another unit, here with none",
            "echo 'unit = \"none\"' | cat - plan.toml > without.toml",
            "rollerrig campaign without.toml --out without_wsp",
            "rollerrig compare with_wsp without_wsp",
        ),
    ),
    Verb(
        "etcs",
        etcs.arguments,
        etcs.call,
        "compute Kdry_rst and Kwet_rst from campaigns on dry and on wet rails",
        "rollerrig etcs campaigns/etcs_dry campaigns/etcs_wet --out reports/etcs",
    ),
    Verb(
        "brake-calculation",
        brake_calculation.arguments,
        brake_calculation.call,
        "compute stopping distance, response time and braked weight by mean values (EN 14531-1)",
        "rollerrig brake-calculation dry_stop --speed 120 --speed 160",
    ),
    Verb(
        "explain",
        explain.arguments,
        explain.call,
        "find where the simulation is wrong and why, and write an extended model",
        "rollerrig explain open_rail_cleaning --out reports/cleaning",
    ),
    Verb(
        "hide",
        discover.hide_arguments,
        discover.hide,
        "write a rig that hides one or two effects, and the key that lists them",
        "rollerrig hide --seed 7 --out sealed.toml",
    ),
    Verb(
        "discover",
        discover.arguments,
        discover.call,
        "find the hidden effects of a rig: run stops, explain them, choose the next stops, repeat",
        "rollerrig discover velim_a1 --stops 5 --out reports/found",
    ),
    Verb(
        "desk",
        desk.arguments,
        desk.call,
        "serve a page for the browser: run the rig, watch it, view its runs",
        "rollerrig desk --open",
    ),
    Verb(
        "view",
        results.view_arguments,
        results.view,
        "open a run in Rerun, or several runs overlaid",
        "rollerrig view runs/demo",
    ),
    Verb(
        "list",
        listing.arguments,
        listing.call,
        "list names and titles: scenarios, faults, signals and more",
        "rollerrig list scenarios",
    ),
    Verb(
        "check",
        check.arguments,
        check.call,
        "show what this machine can do, and how to enable the rest",
        "rollerrig check",
    ),
    Verb(
        "devices",
        devices.arguments,
        devices.call,
        "write the EDS of every node, one DBC, the Modbus maps and the signal table",
        "rollerrig devices --out devices",
    ),
    Verb(
        "bench",
        bench.arguments,
        bench.call,
        "run the benchmarks of this project, and print a table or JSON",
        "rollerrig bench loop --json",
    ),
    Verb(
        "score",
        bench.score_arguments,
        bench.score,
        "judge the answers of any tool on the sets of 'rollerrig bench explain --export'",
        "rollerrig score sets answers.json",
    ),
    Verb(
        "tune",
        tuning.tune_arguments,
        tuning.tune,
        "fit tau of the recovery, or Polach's parameters, to measured data",
        "rollerrig tune velim_synthetic --out reports/tune",
    ),
    Verb(
        "validate",
        tuning.validate_arguments,
        tuning.validate,
        "compute Table 6 on runs that are not fitted: measured, with and without recovery",
        "rollerrig validate velim_synthetic --out reports/validate",
    ),
    Verb(
        "completion",
        completion.arguments,
        completion.call,
        "print the lines that make a shell complete command lines of rollerrig",
        "rollerrig completion bash",
    ),
    Verb(
        "manual",
        manual.arguments,
        manual.call,
        "print the manual page, generated from the parser",
        "rollerrig manual",
    ),
)


def parser(raises: bool = False) -> argparse.ArgumentParser:
    """Return the parser of the whole command line; `raises` as in `Parser`."""
    top = Parser(
        prog="rollerrig",
        description="Hardware-in-the-loop roller-rig emulator for railway wheel slide protection.",
        epilog="example: rollerrig run velim_a1 --out runs/a1",
        raises=raises,
    )
    version = metadata.version("rollerrig")
    top.add_argument("--version", action="version", version=f"rollerrig {version}")

    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    for verb in VERBS:
        # not str.capitalize(), which would turn FMU into fmu
        sentence = verb.summary[0].upper() + verb.summary[1:] + "."
        # the lines of a session stay lines
        formatter = argparse.HelpFormatter
        if verb.session:
            formatter = argparse.RawDescriptionHelpFormatter
        sub = verbs.add_parser(
            verb.name,
            help=verb.summary,
            description=sentence,
            epilog=_epilog(verb),
            formatter_class=formatter,
            raises=raises,
        )
        verb.arguments(sub)
        sub.add_argument(
            "--json",
            action="store_true",
            help="print one JSON object, and nothing else, on standard output",
        )
        sub.add_argument(FROM_PYTHON, action="store_true", help=argparse.SUPPRESS)
        sub.set_defaults(call=verb.call)
        # not for all verbs, because some send their options to other processes
        if verb.call is manual.call:
            sub.set_defaults(top=top)
    return top


def _epilog(verb: Verb) -> str:
    """Return the examples of a verb, which its help ends with."""
    lines = [f"example: {verb.example}"]
    if verb.session:
        lines += ["", "a whole session:", *(f"  {line}" for line in verb.session)]
    return "\n".join(lines)


def _shortened(message: str) -> str:
    """Return a message without its middle if it is very long, because a message quotes input."""
    if len(message) <= MESSAGE_BEGIN + MESSAGE_END:
        return message
    return f"{message[:MESSAGE_BEGIN]} ... {message[-MESSAGE_END:]}"


def _check_names(options: argparse.Namespace) -> None:
    """Raise ConfigError if a name on the command line is no UTF-8, before anything runs.

    Python marks such bytes by half surrogate pairs. Records and reports, which are UTF-8, cannot
    hold them.
    """
    for key, value in vars(options).items():
        values = value if isinstance(value, list | tuple) else [value]
        for one in values:
            if not isinstance(one, str | os.PathLike):
                continue
            try:
                str(one).encode()
            except UnicodeEncodeError:
                # as a shell writes it, so that the user recognises the bytes
                shown = str(one).encode(errors="surrogateescape").decode(errors="backslashreplace")
                raise ConfigError(
                    f"{key.replace('_', '-')}: the name {shown} is not in UTF-8, and records and "
                    "reports are; rename the file or folder, or give another one"
                ) from None


def _error_object(error: RollerrigError) -> dict[str, str]:
    """Return an error for --json: its message, and its kind, which is the name of its class."""
    return {"error": _shortened(str(error)), "kind": type(error).__name__}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    standard_streams.make_harmless()
    if argv is None:
        # this process is the program `rollerrig`, and not a function call in another program
        children.keep_working_folder_out()
        _report_former_variables()
    words = sys.argv[1:] if argv is None else list(argv)
    from_python = FROM_PYTHON in words
    top = parser(raises=from_python)

    # a shell sets this variable when the user presses Tab; argcomplete then exits the process
    if "_ARGCOMPLETE" in os.environ:
        with contextlib.suppress(ImportError):
            importlib.import_module("argcomplete").autocomplete(top)
    try:
        options = top.parse_args(words)
    except ConfigError as error:
        print(json.dumps(_error_object(error)))
        return USAGE

    # python-can is imported here, before any verb does it, to leave out the slow import of asammdf
    with without("asammdf"):
        importlib.import_module("can")

    try:
        _check_names(options)
        status = options.call(options)
        # here, and not when the program exits, where an error could not be reported
        sys.stdout.flush()
        return status
    except RollerrigError as error:
        return _print_error(options, error, from_python)
    except MemoryError:
        return _print_error(options, RollerrigError(NO_MEMORY), from_python)
    except OSError as error:
        if error.errno not in LACKS_OF_MACHINE:
            raise
        return _print_error(options, _lack(error), from_python)
    except KeyboardInterrupt:
        print(f"rollerrig {options.verb}: interrupted", file=sys.stderr)
        return INVALID


def _lack(error: OSError) -> RollerrigError:
    """Return the error for something that the machine lacks."""
    place = f"{error.filename}: " if error.filename else ""
    return RollerrigError(f"{place}{error.strerror}; {LACKS_OF_MACHINE[error.errno or 0]}")


def _report_former_variables() -> None:
    """Print one line if a variable is set that has no effect, and hide it from other processes."""
    found = [name for name in FORMER_VARIABLES if os.environ.pop(name, None) is not None]
    if found:
        print(
            f"rollerrig: {' and '.join(found)} in the environment: no effect, because axles and "
            "equipment are those of the scenario's vehicle",
            file=sys.stderr,
        )


def _print_error(options: argparse.Namespace, error: RollerrigError, from_python: bool) -> int:
    """Print the message of an error and return the exit status."""
    if not from_python:
        print(f"rollerrig {options.verb}: {_shortened(str(error))}", file=sys.stderr)
    if options.json:
        print(json.dumps(_error_object(error)))
    return INVALID if isinstance(error, (UnitLostError, InvalidRunError)) else USAGE


if __name__ == "__main__":
    sys.exit(main())
