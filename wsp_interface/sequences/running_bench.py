"""What a bench that already runs plays, compared with what a sequence starts from.

The bench states its resolved scenario on the bus (object 2041h of node 127). A value of the table
`[start]` that differs there is a reason not to play the sequence. Any other difference is a
warning, and the report has the values of the bench.
"""

import json
import math
import shlex
from collections.abc import Mapping
from typing import Any

from rollerrig.configs.errors import UnitError
from rollerrig.wsp_interface.harness_client import Harness
from rollerrig.wsp_interface.own_bench import DEFAULT_SCENARIO
from rollerrig.wsp_interface.sequences.sequence import Sequence

# keys that do not change the stop: texts, names of sets whose values are compared, and the
# programme of the brake, which the sequence replaces; the speed is compared as it is on the bus
_NOT_COMPARED = ("title", "demand", "duration_max_s", "stand_s", "initial_speed_m_s")
_TABLES_NOT_COMPARED = ("loop", "bus", "modbus")
# the conditions and commands of a sequence are those of a vehicle with this number of axles
_ALWAYS_STATED = ("vehicle.axles",)
_INITIAL_ADHESION = "adhesion.initial_adhesion"
# differences that a warning lists
_LISTED = 8
# a bench that has run for a longer time before its harness joined is not as at its start
_FRESH_S = 0.5
# a speed that differs by less is that of the sequence
_SPEED_SHARE = 0.05
_SPEED_M_S = 0.1


def check_scenario(
    sequence: Sequence, wanted: Mapping[str, Any], actual: Mapping[str, Any]
) -> list[str]:
    """Return a warning on each group of values that differ but are not in `[start]`.

    `wanted` and `actual` are resolved scenarios: of the sequence, and of the bench. Raises
    UnitError if a value of `[start]` differs.
    """
    stated: dict[str, str] = {}
    others: list[str] = []
    names_of_start = _names_of_start(sequence, wanted)
    wanted_leaves = _leaves(wanted)
    actual_leaves = _leaves(actual)
    if wanted_leaves.get(_INITIAL_ADHESION):
        # it decides the friction, which follows from it and from the load
        names_of_start.discard("adhesion.mu_cd")
    for name in sorted(wanted_leaves.keys() | actual_leaves.keys()):
        wanted_value = wanted_leaves.get(name)
        actual_value = actual_leaves.get(name)
        if wanted_value == actual_value:
            continue
        text = f"{name} is {_text(actual_value)} instead of {_text(wanted_value)}"
        if name in names_of_start:
            stated[name] = text
        else:
            others.append(text)

    if stated:
        texts = list(stated.values())
        if sequence.adhesion and any(name.startswith("adhesion.") for name in stated):
            sets = f"{actual.get('adhesion_set')} instead of {wanted.get('adhesion_set')}"
            texts.insert(0, f"the adhesion is {sets}")
        raise UnitError(
            f"pre-condition: the bench does not have the [start] of the sequence: "
            f"{'; '.join(texts)}. Start the bench with: {start_command(sequence)}"
        )
    if not others:
        return []
    listed = "; ".join(others[:_LISTED])
    more = f"; and {len(others) - _LISTED} more" if len(others) > _LISTED else ""
    return [
        f"the bench differs from the scenario '{sequence.scenario or DEFAULT_SCENARIO}' of the "
        f"sequence: {listed}{more}. The report has the values of the bench"
    ]


def check_state(sequence: Sequence, harness: Harness) -> list[str]:
    """Return a warning if the bench has run before its harness joined.

    Raises UnitError if the vehicle does not have the speed of the sequence, or if an earlier
    harness has set the friction.
    """
    actual_m_s = harness.vehicle_speed_m_s
    wanted_m_s = actual_m_s if sequence.speed_m_s is None else sequence.speed_m_s
    if abs(actual_m_s - wanted_m_s) > _SPEED_SHARE * wanted_m_s + _SPEED_M_S:
        raise UnitError(
            f"pre-condition: the sequence begins at {wanted_m_s:.2f} m/s, the bench runs at "
            f"{actual_m_s:.2f} m/s. Start the bench with: {start_command(sequence)}"
        )
    commanded = [axle for axle, mu in harness.commanded_friction().items() if mu]
    if commanded:
        raise UnitError(
            f"pre-condition: an earlier harness has set the friction under axle "
            f"{', '.join(map(str, commanded))}: write 0 to object 2020h of node 127, or start the "
            "bench again"
        )
    if harness.time_s <= _FRESH_S:
        return []
    return [
        f"the bench had run for {harness.time_s:.2f} s before the sequence began. Not known: the "
        "faults that were injected, and the state of rail, wheels, brakes and air at that time"
    ]


def start_command(sequence: Sequence) -> str:
    """Return the command that starts a bench for a sequence."""
    settings = []
    if sequence.speed_m_s is not None:
        settings.append(f"initial_speed_m_s={sequence.speed_m_s:.6g}")
    if sequence.adhesion:
        settings.append(f"adhesion={sequence.adhesion}")
    in_file = []
    for table, content in sequence.tables.items():
        if not isinstance(content, Mapping):
            in_file.append(table)
            continue
        for key, value in content.items():
            settings.append(f"{table}.{key}={_text(value)}")
    settings.append("stand_s=60")
    # a user pastes the command into a shell, where a name must not become a command
    options = " ".join(f"--set {shlex.quote(setting)}" for setting in settings)
    scenario = shlex.quote(sequence.scenario or DEFAULT_SCENARIO)
    command = f"rollerrig run {scenario} --harness {options}"
    if in_file:
        command += f" (and {', '.join(f'[[{table}]]' for table in in_file)} of the sequence in a "
        command += "scenario file)"
    return command


def _names_of_start(sequence: Sequence, wanted: Mapping[str, Any]) -> set[str]:
    """Return the names of all values that `[start]` of a sequence decides."""
    names = set(_ALWAYS_STATED)
    if sequence.adhesion:
        names |= {f"adhesion.{key}" for key in wanted["adhesion"]}
    for table, content in sequence.tables.items():
        if isinstance(content, Mapping):
            names |= {f"{table}.{key}" for key in content}
        else:
            names.add(table)
    return names


def _leaves(resolved: Mapping[str, Any]) -> dict[str, Any]:
    """Return the compared values of a resolved scenario by name, as in `adhesion.mu_cd`."""
    leaves: dict[str, Any] = {}
    for key, content in resolved.items():
        if key in _NOT_COMPARED or key in _TABLES_NOT_COMPARED or key.endswith("_set"):
            continue
        if isinstance(content, Mapping):
            for name, value in content.items():
                leaves[f"{key}.{name}"] = _as_sent(value)
        else:
            leaves[key] = _as_sent(content)
    return leaves


def _as_sent(value: Any) -> Any:
    """Return a value as JSON has it: tuples become lists."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.loads(json.dumps(value))


def _text(value: Any) -> str:
    if value is None:
        return "not given"
    return f"{value:.6g}" if isinstance(value, float) else json.dumps(value)
