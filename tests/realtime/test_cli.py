"""The command line: every verb explains itself, and errors are messages with a status."""

import json
import shlex

import pytest

from rollerrig.realtime import cli


@pytest.mark.parametrize("verb", cli.VERBS, ids=lambda verb: verb.name)
def test_every_verb_shows_an_example_that_its_own_parser_takes(verb, capsys):
    with pytest.raises(SystemExit) as left:
        cli.main([verb.name, "--help"])
    assert left.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert f"example: {verb.example}" in shown
    assert "--json" in shown
    words = shlex.split(verb.example)
    assert words[0] == "rollerrig"
    assert cli.parser().parse_args(words[1:]).verb == verb.name


def test_help_lists_every_verb(capsys):
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    shown = capsys.readouterr().out
    assert all(verb.name in shown and verb.text.split(",")[0][:30] in shown for verb in cli.VERBS)


def test_no_verb_is_a_usage_error(capsys):
    with pytest.raises(SystemExit) as left:
        cli.main([])
    assert left.value.code == cli.USAGE
    assert capsys.readouterr().out == ""


def test_an_unknown_scenario_is_a_message_and_not_a_traceback(capsys):
    assert cli.main(["run", "velim_a9", "--json"]) == cli.USAGE
    told = capsys.readouterr()
    assert "velim_a9" in json.loads(told.out)["error"]
    assert "Traceback" not in told.err


def test_a_wrong_value_names_its_key_and_what_is_allowed(capsys):
    assert cli.main(["run", "velim_a1", "--set", "loop.tick_hz=17"]) == cli.USAGE
    told = capsys.readouterr().err
    assert "tick_hz" in told
    assert "100" in told
