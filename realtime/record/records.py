"""Reads a run's folder: scenario, channels, events, summary.

A run that was killed reads like any other: rows that its recorder had not yet written to the
Parquet file are read from the tail, and an incomplete last line of the events is left out.
"""

import contextlib
import itertools
import json
import re
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from rollerrig.configs import store, user_files, vehicle
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import write_text
from rollerrig.configs.table import nearest
from rollerrig.realtime.record import channels, validity
from rollerrig.realtime.record.run_folder import CAN_LOG, EVENTS, SCENARIO, SUMMARY
from rollerrig.wsp_interface import events as run_events
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Event

_FRAME = re.compile(r"^\((\d+)\.(\d{6})\) \S+ ([0-9A-F]+)#([0-9A-F]*)", re.MULTILINE)
_LONGEST_LINE = 1_000_000  # bytes of an event


class Run(NamedTuple):
    """One run: `table` has one row a sample, `events` are as in `wsp_interface.events`."""

    folder: Path
    table: pa.Table
    scenario: dict[str, Any]
    events: list[Event]
    summary: dict[str, Any]

    @property
    def is_train(self) -> bool:
        """Whether it is the run of a train."""
        return vehicle.TRAIN in self.scenario

    @property
    def kind(self) -> vehicle.Kind:
        """The kind of its vehicle."""
        return vehicle.kind_of(self.scenario, str(self.folder / SCENARIO))

    @property
    def signal_table(self) -> signals.Table:
        """The signals of its vehicle."""
        return signals.table(self.kind)

    def column(self, name: str) -> np.ndarray:
        """Return one channel, shape (n,).

        Raises ConfigError, which lists the channels of the run.
        """
        if name not in self.table.column_names:
            hint = nearest(name, self.table.column_names, "The run has")
            raise ConfigError(f"{self.folder}: no channel is called '{name}'{hint}")
        return channels.values(self.table[name])


def load(folder: Path | str) -> Run:
    """Read a run's folder.

    Raises ConfigError for a file that is missing or damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ConfigError(
            f"{folder}: no such folder; give one that 'rollerrig run ... --out DIR' has written"
        )
    if not (folder / SCENARIO).is_file():
        raise ConfigError(f"{folder / SCENARIO}: no such file; {folder} is not a run's folder")
    resolved = store.parse(folder / SCENARIO, within=folder)
    if vehicle.TRAIN not in resolved:
        # raises ConfigError for a vehicle that there cannot be
        vehicle.kind_of(resolved, str(folder / SCENARIO))
    return Run(
        folder,
        channels.load(folder),
        resolved,
        events(folder),
        summary(folder),
    )


def events(folder: Path) -> list[Event]:
    """Return the events of a run; none where there is no file."""
    return list(each_event(folder))


def each_event(folder: Path) -> Iterator[Event]:
    """Yield the events of a run one after another: a flood of them may exceed the memory."""
    path = folder / EVENTS
    if not path.is_file():
        return
    with user_files.open_binary(path, user_files.EVENTS, within=folder) as lines:
        for number in itertools.count(1):
            # a line is limited, because a damaged file may be a single line
            line = lines.readline(_LONGEST_LINE).decode("utf-8", errors="replace")
            if not line:
                break
            try:
                event = run_events.from_json(user_files.parse_json(line))
            except (ValueError, KeyError, TypeError, AttributeError):
                if not line.endswith("\n") and len(line) < _LONGEST_LINE:
                    break  # cut off by a kill
                raise ConfigError(
                    f"{path}, line {number}: not an event; a line is "
                    '{"time_s": 0.0, "level": "info", "text": "...", "code": "...", "fields": {...}}'
                ) from None
            yield event


def frames(folder: Path) -> list[tuple[int, int, str]]:
    """Return time in us, identifier and data in hex of every frame in can.log.

    Empty without a file.
    """
    path = folder / CAN_LOG
    text = ""
    if path.is_file():
        text = user_files.read_text(path, user_files.CAN_LOG, within=folder)
    return [
        (1_000_000 * int(seconds) + int(micros), int(can_id, 16), data)
        for seconds, micros, can_id, data in _FRAME.findall(text)
    ]


def summary(folder: Path) -> dict[str, Any]:
    """Return the summary of a run; empty while the run has none."""
    path = folder / SUMMARY
    if not path.is_file():
        return {}
    content = user_files.read_json(path, within=folder)
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: an object is wanted, not {type(content).__name__}")
    return content


def not_valid(folders: Iterable[Path]) -> list[str]:
    """Return a sentence for each run that is not valid, with its reasons."""
    sentences: list[str] = []
    for folder in folders:
        reasons = validity.because(summary(folder))
        if reasons:
            sentences.append(f"{folder} is not valid: {'; '.join(reasons)}")
    return sentences


def write_summary(folder: Path, content: dict[str, Any]) -> None:
    """Write a summary in one step.

    Raises ConfigError, and writes it to the temporary folder if possible.
    """
    text = json.dumps(content, indent=2) + "\n"
    try:
        write_text(folder / SUMMARY, text)
    except OSError as error:
        kept = "its summary is lost"
        with contextlib.suppress(OSError):
            spare = Path(tempfile.mkdtemp(prefix=f"rollerrig-{folder.name}-"), SUMMARY)
            spare.write_text(text, encoding="utf-8")
            kept = f"its summary is kept in {spare}"
        raise ConfigError(
            f"{folder} cannot be written: {error.strerror}; {kept}, what was recorded is in the "
            "folder; make room, or give a folder elsewhere with --out, and run again"
        ) from None


def rows(table: pa.Table | pa.RecordBatch, signal_table: signals.Table) -> np.ndarray:
    """Return channels of a vehicle as rows of all signals, shape (n, signals.WIDTH).

    Missing channels are NaN.
    """
    recorded = np.full((len(table), len(signal_table.columns)), np.nan)
    for at, name in enumerate(signal_table.columns):
        if name in table.schema.names:
            recorded[:, at] = channels.values(table[name])
    return signal_table.rows_of_all(recorded)
