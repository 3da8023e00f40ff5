"""Prints the results of verbs: with --json one object on standard output, else tables and text.

Progress and messages go to standard error.
"""

import argparse
import contextlib
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.printable import printable
from rollerrig.realtime import standard_streams

# exit statuses of the command line that several verbs return
PASS = 0
FAILED = 1
USAGE = 2
INVALID = 4

# the spread of a figure, as `figures.spread_of` returns it, with the heads of its columns
SPREAD = {
    "mean": "mean",
    "standard_deviation": "standard deviation",
    "least": "least",
    "largest": "largest",
}

# a little less than 5 s, so that a busy machine, too, prints a line every five seconds
PERIOD_S = 4.9


def report_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of verbs that write a report which people sign."""
    parser.add_argument(
        "--about",
        action="append",
        default=[],
        metavar="'WHAT=TEXT'",
        help="entry in the title block of the report, as in 'document number=R-12', 'revision=B', "
        "'unit under test=ACME 7' or 'tested by=A. Meier'; names of 'tested by', 'checked by' and "
        "'approved by' are also where these people sign; may be repeated",
    )
    parser.add_argument(
        "--pdf", action="store_true", help="write the report as PDF as well (report.pdf)"
    )


def about(options: argparse.Namespace) -> dict[str, str]:
    """Return the entries of the title block that `--about` gives. Raises ConfigError."""
    from rollerrig.realtime.record import played

    entries = {}
    for text in options.about:
        key, equals_sign, value = text.partition("=")
        if not equals_sign or not key.strip():
            raise ConfigError(f"--about '{text}': write WHAT=TEXT, as in 'tested by=A. Meier'")
        if key.strip().lower() == played.UNIT_PLAYED:
            raise ConfigError(
                f"--about '{text}': which unit was played is recorded and cannot be stated; write "
                "'unit under test=...' for its name"
            )
        entries[key.strip()] = value.strip()
    return entries


def print_message(text: str) -> None:
    """Print a line of progress, or a message, on standard error."""
    print(text, file=sys.stderr, flush=True)


def rewrite_line(text: str) -> None:
    """Write a text over the last line of the terminal on standard error, without a new line."""
    print("\r" + printable(text), end="", file=standard_streams.drawing(sys.stderr), flush=True)


def console(error: bool = False) -> Any:
    """Return a console of rich on standard output, or on standard error.

    It reads no text as markup, and makes hidden characters in what it draws visible.
    """
    # imported here because --json does not need it
    from rich.console import Console

    class PrintableConsole(Console):
        """A console that makes hidden characters visible. Its escape sequences are controls."""

        def render(self, *arguments: Any, **options: Any) -> Any:
            """Yield the segments of what is drawn."""
            for segment in super().render(*arguments, **options):
                if segment.control:
                    yield segment
                else:
                    yield segment._replace(text=printable(segment.text))

    stream = standard_streams.drawing(sys.stderr if error else sys.stdout)
    return PrintableConsole(file=stream, highlight=False, markup=False)


@contextlib.contextmanager
def report_progress(
    describe: Callable[[], str], period_s: float = 0.0, draws: bool = False
) -> Iterator[None]:
    """Print the progress of long work now and then, if standard error is not a terminal.

    describe: returns how far the work is, "" as long as there is nothing to print.
    period_s: between two lines; 0: five seconds.
    draws: on a terminal, the text is drawn as a line that changes. Without it the verb draws a
        progress bar there.
    """
    if sys.stderr.isatty():
        with _drawn(describe) if draws else contextlib.nullcontext():
            yield
        return

    finished = threading.Event()
    start_s = time.monotonic()

    def print_until_finished() -> None:
        while not finished.wait(period_s or PERIOD_S):
            elapsed_s = time.monotonic() - start_s
            if text := describe():
                print_message(f"{text} ({elapsed_s:.0f} s)")

    threading.Thread(target=print_until_finished, name="progress", daemon=True).start()
    try:
        yield
    finally:
        finished.set()


def _drawn(describe: Callable[[], str]) -> Any:
    """Return a context in which a text is drawn on the terminal, below what is printed."""
    from rich.live import Live
    from rich.text import Text

    return Live(
        get_renderable=lambda: Text(describe()),
        console=console(error=True),
        refresh_per_second=2,
        transient=True,
        redirect_stdout=False,
    )


def show(options: argparse.Namespace, result: Mapping[str, Any], *items: Any) -> int:
    """Print the result of a verb on standard output and return PASS.

    With --json, the result is printed as one JSON object. Without it, the warnings of the result
    are printed, and then the items: a str is a line, a tuple (title, head, rows) is a table, and
    anything else is printed as rich prints it. No str is read as the markup of rich.
    """
    if options.json:
        print(json.dumps(result, default=str))
        return PASS

    terminal = console()
    warnings = [f"warning: {warning}" for warning in result.get("warnings", ())]
    for item in (*warnings, *items):
        if isinstance(item, str):
            # printed without line breaks: users copy paths and commands from here
            terminal.print(item, soft_wrap=True)
        elif isinstance(item, tuple):
            title, head, rows = item
            terminal.print(_table(title, head, rows))
        else:
            terminal.print(item)
    return PASS


def _table(title: str | None, head: Any, rows: Any) -> Any:
    """Return a rich table whose columns fold on a narrow terminal and are never cut."""
    from rich.table import Column, Table

    columns = [Column(name, overflow="fold") for name in head]
    table = Table(*columns, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    return table
