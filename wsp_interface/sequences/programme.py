"""A test programme: groups of sequences, as a standard for wheel slide protection arranges them.

A programme is a TOML file. Each group has a kind, and a source for what it contains:

    mandatory       counts for the result
    by agreement    counts for the result, if the parties agree on it; here it always runs
    additional      runs and is reported, and does not count for the result
    apart           not run here: `reason` states why, and where it belongs
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import known, nearest
from rollerrig.wsp_interface import signals

MANDATORY = "mandatory"
BY_AGREEMENT = "by agreement"
ADDITIONAL = "additional"
APART = "apart"
KINDS = (MANDATORY, BY_AGREEMENT, ADDITIONAL, APART)
# kinds whose sequences count for the result
COUNTED = (MANDATORY, BY_AGREEMENT)

# Names of the signals of any vehicle. A programme is read before it is known which vehicle its
# sequences have, and a record without a signal of this list is an error in the evidence.
_SIGNALS = tuple(signal.name for signal in signals.ALL_SIGNALS)
_KEYS = ("title", "source", "notes", "log", "group")
_GROUP_KEYS = ("title", "kind", "source", "sequences", "reason")


class Group(NamedTuple):
    """A group of a programme.

    sequences: names or paths of its sequences; empty if `kind` is APART.
    reason: why it is not run here; "" for the other kinds.
    """

    title: str
    kind: str
    source: str
    sequences: tuple[str, ...]
    reason: str


class Programme(NamedTuple):
    """A checked programme.

    source: where its contents are from.
    notes: its limits, for readers of the evidence.
    log: names of the signals that the record of each run must have.
    left_out: titles of the groups that were not chosen; empty for the whole programme.
    """

    name: str
    path: Path
    title: str
    source: str
    notes: tuple[str, ...]
    log: tuple[str, ...]
    groups: tuple[Group, ...]
    left_out: tuple[str, ...] = ()

    @property
    def counted(self) -> tuple[str, ...]:
        """The kinds of groups that count for the result.

        If a part of the programme has no group of these kinds, all its groups count.
        """
        kinds = {group.kind for group in self.groups}
        return COUNTED if kinds & set(COUNTED) else KINDS

    def part(self, chosen: Sequence[str]) -> "Programme":
        """Return a part of the programme: the groups with these titles, or beginnings of titles.

        Raises ConfigError for an unknown group, and for one that is not run here.
        """
        picked = {self._group(text) for text in chosen}
        return self._replace(
            groups=tuple(group for group in self.groups if group in picked),
            left_out=tuple(group.title for group in self.groups if group not in picked),
        )

    def _group(self, text: str) -> Group:
        """Return the group whose title is a text, or begins with it, in capitals or not."""
        wanted = text.strip().casefold()
        titles = [group.title.casefold() for group in self.groups]
        if wanted in titles:
            found = [self.groups[titles.index(wanted)]]
        else:
            found = [
                group
                for group, title in zip(self.groups, titles, strict=True)
                if wanted and title.startswith(wanted)
            ]
        if len(found) != 1:
            several = "several groups begin so" if found else "there is no such group"
            allowed = "; ".join(group.title for group in self.groups if group.kind != APART)
            raise ConfigError(
                f"--group '{text}': {several}; give the title or its beginning: {allowed}"
            )
        (group,) = found
        if group.kind == APART:
            raise ConfigError(f"--group '{text}': this group is not run here: {group.reason}")
        return group

    @property
    def sequences(self) -> tuple[str, ...]:
        """The names of all sequences, in their order."""
        return tuple(name for group in self.groups for name in group.sequences)


def load(name: str) -> Programme:
    """Return a programme by name or path. Raises ConfigError."""
    content, path = store.load("programmes", name)
    where = str(path)
    known(content, _KEYS, lambda key: where)
    log = _texts(content, "log", where)
    for signal in log:
        if signal not in _SIGNALS:
            raise ConfigError(f"{where}: log: no signal '{signal}'{nearest(signal, _SIGNALS)}")
    tables = content.get("group", [])
    if not isinstance(tables, list) or not tables:
        raise ConfigError(f"{where}: has no group; write [[group]] with title, kind and sequences")
    groups = tuple(
        _group(table, f"{where} group {number}", path)
        for number, table in enumerate(tables, start=1)
    )
    programme = Programme(
        path.stem,
        path,
        _text(content, "title", where),
        _text(content, "source", where),
        _texts(content, "notes", where),
        log,
        groups,
    )
    for sequence in sorted(set(programme.sequences)):
        if programme.sequences.count(sequence) > 1:
            raise ConfigError(f"{where}: the sequence '{sequence}' is in the programme twice")
    return programme


def _group(table: Any, where: str, path: Path) -> Group:
    """Return one group. Raises ConfigError."""
    known(table, _GROUP_KEYS, lambda key: where)
    kind = _text(table, "kind", where)
    if kind not in KINDS:
        raise ConfigError(f"{where}: kind = '{kind}'{nearest(kind, KINDS)}")
    sequences = _texts(table, "sequences", where)
    reason = table.get("reason", "")
    if kind == APART and (sequences or not isinstance(reason, str) or not reason.strip()):
        raise ConfigError(
            f"{where}: a group that is {APART} has a reason and no sequences; write the reason, or "
            "another kind"
        )
    if kind != APART and (not sequences or reason):
        raise ConfigError(
            f"{where}: a {kind} group has sequences and no reason; write sequences = [...]"
        )
    found = tuple(str(store.find("sequences", sequence, path)) for sequence in sequences)
    return Group(_text(table, "title", where), kind, _text(table, "source", where), found, reason)


def _text(table: Mapping[str, Any], key: str, where: str) -> str:
    """Return a text that must not be empty."""
    value = table.get(key)
    if not isinstance(value, str) or not value.strip():
        raise ConfigError(f'{where}: {key} is missing; write {key} = "..."')
    return value


def _texts(table: Mapping[str, Any], key: str, where: str) -> tuple[str, ...]:
    """Return a list of texts; it may be missing."""
    value = table.get(key, [])
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise ConfigError(f'{where}: {key} = {value!r}: must be a list of texts, as in ["a", "b"]')
    return tuple(value)
