"""Events: every code has a row that makes a sentence.

Programs use codes and fields, never the text.
"""

import ast
import re
from pathlib import Path

import pytest
from each import for_each

from rollerrig.wsp_interface import events
from rollerrig.wsp_interface.events import TABLE, Code

ROOT = Path(__file__).parent.parent
ROOMS = ("configs", "rig", "firmware_sim", "wsp_interface", "realtime")
FILES = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]
# where `text` is the text of something else
OTHER_TEXTS = {
    "rig/identify/train_recorder/faults.py": "the text of a finding",
    "wsp_interface/sequences/verdict.py": "the text of a verdict",
}
# what reads a string, by the name of the method: of str, and of re with the string as an argument
STRING_METHODS = {
    "count",
    "endswith",
    "find",
    "index",
    "partition",
    "removeprefix",
    "removesuffix",
    "rpartition",
    "rsplit",
    "split",
    "splitlines",
    "startswith",
}
PATTERN_METHODS = {"findall", "finditer", "fullmatch", "match", "search", "split", "sub"}
SAMPLES = {str: "abc", int: 7, float: 1.5, bool: True, list: [1, 2]}


def sample(row):
    """Values for all fields of a row."""
    return {name: SAMPLES[kind] for name, kind in row.fields.items()}


# --- the table ---


def test_every_code_has_one_row_and_every_row_a_code():
    assert list(TABLE) == list(Code)


@for_each(Code)
def test_a_code_is_dotted_lower_case(code):
    assert re.fullmatch(r"[a-z]+(_[a-z]+)*\.[a-z]+(_[a-z]+)*", code)


@for_each(Code)
def test_a_row_makes_its_sentence_from_its_fields(code):
    row = TABLE[code]
    event = events.make(2.5, code, **sample(row))
    assert (event.time_s, event.code, event.level) == (2.5, code, row.level)
    assert event.fields == sample(row)
    assert event.text
    assert not set(event.text) & set("{}[]")


@for_each(Code)
def test_a_sentence_uses_only_fields_of_its_row(code):
    row = TABLE[code]
    for template in (row.sentence, row.advice):
        assert events.fields_in(template.replace("[", "").replace("]", "")) <= set(row.fields)


@for_each(Code)
def test_a_row_has_a_known_level_and_types_that_json_has(code):
    row = TABLE[code]
    assert row.level in events.LEVELS
    assert set(row.fields.values()) <= set(SAMPLES)


@for_each([code for code in Code if events.optional(TABLE[code])])
def test_a_part_in_brackets_is_left_out_without_its_value(code):
    row = TABLE[code]
    whole = events.text(code, sample(row))
    short = events.text(code, sample(row) | dict.fromkeys(events.optional(row)))
    assert len(short) < len(whole)
    assert "None" not in short


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, "allowed: .'node', 'silent_s'"),
        ({"node": 32}, "fields .'node'., allowed"),
        ({"node": 32, "silent_s": 0.2, "why": ""}, "'why'"),
        ({"node": "32", "silent_s": 0.2}, "node is '32', allowed: int"),
        ({"node": None, "silent_s": 0.2}, "node is None, allowed: int"),
    ],
)
@pytest.mark.parametrize("call", [events.ignore, lambda *a, **f: events.make(0.0, *a, **f)])
def test_wrong_fields_are_an_error_where_the_event_is_made(call, fields, message):
    with pytest.raises(TypeError, match=message):
        call(Code.UNIT_LOST, **fields)


def test_values_are_shown_in_the_units_that_people_use():
    event = events.make(0.0, Code.AIR_EXHAUSTED, reservoir_Pa=312_345.0, demand_Pa=380_000.0)
    assert "3.12 bar" in event.text
    assert "3.8 bar" in event.text
    assert "200 ms" in events.make(0.0, Code.UNIT_LOST, node=32, silent_s=0.2).text


def test_advice_can_be_left_out_of_a_sentence():
    fields = {"side": "left", "axle": 3, "distance_m": 12.0}
    short = events.text(Code.COACH_DERAILED, fields, advice=False)
    assert short == "derailed: the left wheel of axle 3 left its rail after 12.0 m"
    assert events.text(Code.COACH_DERAILED, fields).startswith(f"{short}; ")


def test_every_code_is_documented(docs):
    page = (docs / "events.md").read_text(encoding="utf-8")
    assert page == events.markdown(), "run: make docs"
    assert [code for code in Code if f"| `{code}` |" not in page] == []


# --- who reads events ---


def is_text(node):
    """Whether an expression is `x.text` or `x["text"]`."""
    if isinstance(node, ast.Attribute):
        return node.attr == "text"
    return (
        isinstance(node, ast.Subscript)
        and isinstance(node.slice, ast.Constant)
        and node.slice.value == "text"
    )


def reads_text(node):
    """Whether an expression compares, searches or takes apart a text."""
    if isinstance(node, ast.Compare):
        return any(map(is_text, (node.left, *node.comparators)))
    if isinstance(node, ast.Match):
        return is_text(node.subject)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        of_string = node.func.attr in STRING_METHODS and is_text(node.func.value)
        of_pattern = node.func.attr in PATTERN_METHODS and any(map(is_text, node.args))
        return of_string or of_pattern
    return False


def is_place_of_an_event(node):
    """Whether an expression is `event[NUMBER]`: an event has names."""
    return (
        isinstance(node, ast.Subscript)
        and isinstance(node.value, ast.Name)
        and node.value.id == "event"
        and isinstance(node.slice, ast.Constant)
        and isinstance(node.slice.value, int)
    )


@for_each(FILES)
def test_no_program_reads_the_text_of_an_event(path):
    if path.relative_to(ROOT).as_posix() in OTHER_TEXTS:
        return
    found = [
        f"line {node.lineno}: {ast.unparse(node)}"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if reads_text(node) or is_place_of_an_event(node)
    ]
    assert found == []


@pytest.mark.parametrize(
    "line",
    [
        "'lost' in event.text",
        "event.text == 'lost'",
        "event['text'].startswith('fault')",
        "re.match('fault', one['text'])",
        "_FAULT.search(event.text)",
        "event.text.partition(':')[2]",
        "event[2]",
    ],
)
def test_the_test_of_programs_finds_who_reads_a_text(line):
    nodes = list(ast.walk(ast.parse(line)))
    assert any(reads_text(node) or is_place_of_an_event(node) for node in nodes)
