"""What a verb prints: with --json one object on standard output, else tables and text; progress on standard error."""

import argparse
import contextlib
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

PASS, FAILED, INVALID = 0, 1, 4
PERIOD_S = 4.9  # on a busy machine, too, there is a line every five seconds


def print_message(text: str) -> None:
    """Progress, on standard error."""
    print(text, file=sys.stderr, flush=True)


@contextlib.contextmanager
def report_progress(what: Callable[[], str]) -> Iterator[None]:
    """Say every five seconds how far long work is, as `what` tells it, where no terminal shows it otherwise."""
    over, begun_s = threading.Event(), time.monotonic()

    def tell() -> None:
        while not over.wait(PERIOD_S):
            print_message(f"{what()} ({time.monotonic() - begun_s:.0f} s)")

    thread = threading.Thread(target=tell, name="progress", daemon=True)
    if not sys.stderr.isatty():
        thread.start()
    try:
        yield
    finally:
        over.set()


def show(given: argparse.Namespace, result: Mapping[str, Any], *shown: Any) -> int:
    """The result as JSON, or its warnings and what is shown of it: lines, tables as (title, head, rows), anything rich.

    Returns PASS.
    """
    if given.json:
        print(json.dumps(result, default=str))
        return PASS
    from rich.console import Console
    from rich.table import Column, Table

    console = Console(highlight=False)
    for one in (*(f"warning: {warning}" for warning in result.get("warnings", ())), *shown):
        if isinstance(one, str):
            console.print(
                one, markup=False, soft_wrap=True
            )  # as it is: a path or a command is copied from there
        elif isinstance(one, tuple):
            title, head, rows = one
            table = Table(
                *(Column(name, overflow="fold") for name in head), title=title, title_justify="left"
            )
            for row in rows:
                table.add_row(*row)
            console.print(table)
        else:
            console.print(one)
    return PASS
