"""The report of a study: the result of `tune`, `validate` or `explain` in three forms.

Programs read the JSON file. People read the page and the summary in the terminal.

The module of each study makes one `StudyReport`. `realtime.commands.study` writes its files and
prints it.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from rich.text import Text

# a table: the titles of its columns, and its rows
Table = tuple[Sequence[str], Sequence[Sequence[str]]]


class Model(NamedTuple):
    """A model that a study writes, as TOML."""

    file_name: str
    toml: str


class StudyReport(NamedTuple):
    """A report in its three forms, and the model where the study makes one.

    Each item of the summary is a line (str), a table (title, head, rows) or rich text.
    """

    result: dict[str, Any]  # content of the JSON file
    page: str  # HTML
    summary: tuple[Any, ...]  # for the terminal
    model: Model | None = None


def verdict_and_sentences(verdict: str, name: str, sentences: Sequence[str]) -> tuple[Text, ...]:
    """Return the summary of an explanation: a title in bold, then the sentences.

    The title is the verdict with the `name` of the dataset or recording.
    """
    title = Text(f"{verdict}: {name}", "bold")
    lines = [Text(sentence) for sentence in sentences]
    return (title, *lines)
