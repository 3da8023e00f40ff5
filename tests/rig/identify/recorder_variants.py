"""Writes one recording in other forms, and compares the answers of `explain`.

    python tests/rig/identify/recorder_variants.py [FOLDER ...]

explains each recording as it is and in each form: in km/h, with fewer digits, thinned to fewer
samples, logged on change, with semicolons and decimal commas. An answer agrees if it is the same,
or if what is missing could not be judged, or is below the smallest size that the report states.
Without FOLDER the public recordings of tests/data/measured are taken.
"""

import argparse
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.train_recorder import recording, verdict
from rollerrig.rig.identify.train_recorder.findings import Finding
from rollerrig.rig.identify.train_recorder.recording import Run
from rollerrig.rig.identify.train_recorder.verdict import Account

MEASURED = Path(__file__).parents[2] / "data" / "measured"

# files are written with this many digits if a form does not round
_DIGITS = 5

_KEY_OF_QUANTITY = {
    "reference": "reference_speed_m_s",
    "position": "position_m",
    "demand": "brake_demand",
    "yaw": "yaw_rate_rad_s",
}
_SPEEDS = ("speed", "reference")


class Table(NamedTuple):
    """Stamps (n,) in s and the values (n,) of each channel in SI units, by name."""

    time_s: np.ndarray
    values: dict[str, np.ndarray]


class Form(NamedTuple):
    """How a recording is written: unit, digits of speeds, stamps, and marks."""

    name: str
    unit: str = "m/s"
    digits: int = _DIGITS
    rate_hz: float = 0.0  # 0: as it is
    on_change: bool = False
    separator: str = ","
    decimal: str = "."


FORMS = (
    Form("km/h", unit="km/h"),
    Form("0.1 km/h", unit="km/h", digits=1),
    Form("1 km/h", unit="km/h", digits=0),
    Form("0.01 m/s", digits=2),
    Form("50 Hz", rate_hz=50.0),
    Form("10 Hz", rate_hz=10.0),
    Form("5 Hz", rate_hz=5.0),
    Form("2 Hz", rate_hz=2.0),
    Form("1 Hz", rate_hz=1.0),
    Form("on change", unit="km/h", digits=1, on_change=True),
    Form("semicolons", separator=";", decimal=","),
)


def _table(run: Run) -> Table:
    """Return all channels of a run on the stamps of its fastest channel; gaps stay gaps."""
    base = max(run.channels.values(), key=lambda channel: channel.values.size)
    values = {}
    for name, channel in run.channels.items():
        if channel.time_s.size == base.time_s.size:
            values[name] = channel.values
        else:
            values[name] = np.interp(base.time_s, channel.time_s, channel.values)
    return Table(base.time_s, values)


def _thinned(table: Table, rate_hz: float) -> Table:
    """Return the first sample of each interval of 1 / rate."""
    interval = np.floor((table.time_s - table.time_s[0]) * rate_hz + 1e-6)
    first = np.concatenate([[True], np.diff(interval) > 0.0])
    values = {name: column[first] for name, column in table.values.items()}
    return Table(table.time_s[first], values)


def _rounded(run: Run, table: Table, form: Form) -> dict[str, np.ndarray]:
    """Return the values as they are written."""
    written = {}
    for name, column in table.values.items():
        if run.channels[name].quantity in _SPEEDS:
            factor = 3.6 if form.unit == "km/h" else 1.0
            written[name] = np.round(factor * column, form.digits)
        else:
            written[name] = np.round(column, _DIGITS)
    return written


def write(source: Path, folder: Path, form: Form) -> None:
    """Write a recording in a form."""
    data = recording.load(source)
    lines = ['kind = "recorder"']
    given = [run.hardest_m_s2 for run in data.runs if run.hardest_is_given]
    if given:
        lines.append(f"hardest_m_s2 = {given[0]}")
    lines += ["[channels]", 'time_s = { column = "t" }']
    for name, channel in data.runs[0].channels.items():
        key = _KEY_OF_QUANTITY.get(channel.quantity, f"wheel_speed_{max(channel.axle, 1)}_m_s")
        if channel.quantity == "speed" and not channel.axle:
            number = [c.name for c in data.runs[0].of("speed")].index(name) + 1
            key = f"bogie_speed_{number}_m_s"
        unit = f', unit = "{form.unit}"' if channel.quantity in _SPEEDS else ""
        delay = f", delay_s = {channel.delay_s}" if channel.quantity in _SPEEDS else ""
        lines.append(f'{key} = {{ column = "{name}", name = "{name}"{unit}{delay} }}')

    for run in data.runs:
        table = _table(run)
        if form.rate_hz:
            table = _thinned(table, form.rate_hz)
        written = _rounded(run, table, form)
        rows = [form.separator.join(["t", *written])]
        before: tuple[float, ...] = ()
        for k, time_s in enumerate(table.time_s):
            values = tuple(column[k] for column in written.values())
            if form.on_change and values == before:
                continue
            before = values
            cells = [f"{time_s:.4f}", *(f"{v:.{_DIGITS}f}" if v == v else "" for v in values)]
            rows.append(form.separator.join(cells).replace(".", form.decimal))
        file = f"{run.name}.csv".replace("/", "_")
        (folder / file).write_text("\n".join(rows) + "\n")
        lines += ["[[run]]", f'file = "{file}"']
        lines += [f'date = "{run.date}"'] if run.date else []
        lines += [f'vehicle_id = "{run.vehicle_id}"'] if run.vehicle_id else []
    (folder / "dataset.toml").write_text("\n".join(lines) + "\n")


# --- comparison ---


def _key(finding: Finding) -> tuple[str, tuple[str, ...]]:
    return finding.name, finding.channels


def contradictions(original: Account, other: Account) -> list[str]:
    """Return what the answer to another form reports falsely or leaves out without a reason."""
    found = {_key(finding): finding for finding in original.findings}
    others = {_key(finding): finding for finding in other.findings}
    problems = []
    for key, finding in others.items():
        name, channels = key
        if key in found:
            first = found[key]
            agree = finding.low <= first.high and first.low <= finding.high
            if name in ("wheel_radius", "speed_scale", "speed_offset") and not agree:
                problems.append(f"{name} of {channels}: {finding.size:.3g}, not {first.size:.3g}")
        elif not any(name == known and set(channels) & set(of) for known, of in found):
            problems.append(f"new: {name} of {', '.join(channels)}: {finding.size:.3g}")
    checks = {check.name: check for check in other.checks}
    for key, finding in found.items():
        name, channels = key
        check = checks[name]
        is_refused = not check.judged or set(channels) <= set(check.channels)
        is_small = not is_refused and abs(finding.low) <= check.smallest
        is_short = name in ("slide", "driving_slip") and _longest_s(finding) < 1.5 * check.values[0]
        kept = any(name == known and set(channels) & set(of) for known, of in others)
        if not kept and not is_refused and not is_small and not is_short:
            problems.append(f"missing: {name} of {', '.join(channels)}: {finding.size:.3g}")
    if other.unknown and not original.unknown:
        first_unknown = other.unknown[0]
        problems.append(f"unknown: {', '.join(first_unknown.channels)}")
    return problems


def _longest_s(finding: Finding) -> float:
    """Return how long the longest cycle of an episode lasts, s."""
    lengths = [cycle.end_s - cycle.start_s for cycle in getattr(finding.details, "cycles", ())]
    return max(lengths, default=finding.end_s - finding.start_s)


def compare(source: Path, form: Form, original: Account) -> tuple[str, list[str]]:
    """Return the verdict on a recording in a form, or "refused: ...", and the contradictions."""
    with tempfile.TemporaryDirectory() as folder:
        write(source, Path(folder), form)
        try:
            account = verdict.explain(recording.load(folder))
        except ConfigError as error:
            return f"refused: {str(error).split(': ', 1)[-1]}", []
    return account.verdict, contradictions(original, account)


def usable(source: Path, form: Form) -> bool:
    """Whether a form is another one: thinning needs more samples than it leaves."""
    if not form.rate_hz:
        return True
    data = recording.load(source)
    step_s = max(c.step_s for run in data.runs for c in run.of("speed"))
    return form.rate_hz * step_s < 0.8


def public_recordings() -> list[Path]:
    """Return the public recordings of the repository."""
    return [
        path.parent
        for path in sorted(MEASURED.glob("*/dataset.toml"))
        if path.parent.name.endswith(("_mit", "_apache"))
        and 'kind = "recorder"' in path.read_text()
    ]


def main() -> None:
    """Explain recordings in all forms and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="*", type=Path, help="datasets of recorders")
    folders: list[Path] = parser.parse_args().folder or public_recordings()
    total = 0
    wrong = 0
    for source in folders:
        original = verdict.explain(recording.load(source))
        print(f"{source.name}: {original.verdict}")
        for form in FORMS:
            if not usable(source, form):
                continue
            answer, problems = compare(source, form, original)
            total += 1
            wrong += bool(problems)
            print(f"  {form.name:12} {answer:14.90} {'; '.join(problems)[:200]}", flush=True)
    print(f"{wrong} of {total} forms contradict the recording as it is")


if __name__ == "__main__":
    main()
