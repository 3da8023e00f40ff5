"""The report of a study: what tune, validate and explain return for programs, for people and as a page.

The module of each study makes one `StudyReport`. `realtime.commands.study` writes its files and
prints it.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from rich.text import Text

# head and rows of a table
Table = tuple[Sequence[str], Sequence[Sequence[str]]]


class Model(NamedTuple):
    """A model that a study writes, as TOML."""

    file_name: str
    toml: str


class StudyReport(NamedTuple):
    """A report in its three forms, and the model where the study makes one."""

    result: dict[str, Any]  # content of the JSON file
    page: str  # HTML
    summary: tuple[Any, ...]  # for the terminal: lines, (title, head, rows), rich text
    model: Model | None = None


def verdict_and_sentences(verdict: str, name: str, sentences: Sequence[str]) -> tuple[Text, ...]:
    """Return the summary of an explanation: the verdict in bold, then its sentences."""
    return (Text(f"{verdict}: {name}", "bold"), *map(Text, sentences))
