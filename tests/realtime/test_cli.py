"""The command line: every verb explains itself, and errors are messages with a status."""

import json
import os
import re
import shlex
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

import pytest

from rollerrig.configs import store
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime import cli
from rollerrig.realtime.commands import explain, listing, output


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


@pytest.mark.nightly
@pytest.mark.parametrize(
    "verb", [verb for verb in cli.VERBS if verb.session], ids=lambda verb: verb.name
)
def test_the_session_that_a_verb_shows_works_as_it_is_printed(verb, capsys, tmp_path):
    with pytest.raises(SystemExit):
        cli.main([verb.name, "--help"])
    shown = capsys.readouterr().out.partition("a whole session:\n")[2]
    # few runs, to save time
    script = shown.replace("runs = 40", "runs = 4")
    assert script != shown
    path = f"{os.path.dirname(sys.executable)}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-e"],
        input=script,
        text=True,
        capture_output=True,
        cwd=tmp_path,
        env=os.environ | {"PATH": path},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "without_wsp stops longer than with_wsp" in done.stdout


def test_help_lists_every_verb(capsys):
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    shown = capsys.readouterr().out
    assert all(
        verb.name in shown and verb.summary.split(",")[0][:30] in shown for verb in cli.VERBS
    )


def test_no_verb_is_a_usage_error(capsys):
    with pytest.raises(SystemExit) as left:
        cli.main([])
    assert left.value.code == cli.USAGE
    assert capsys.readouterr().out == ""


def test_an_unknown_scenario_is_a_message_and_not_a_traceback(capsys):
    assert cli.main(["run", "velim_a9", "--json"]) == cli.USAGE
    printed = capsys.readouterr()
    assert "velim_a9" in json.loads(printed.out)["error"]
    assert "Traceback" not in printed.err


def test_a_wrong_value_names_its_key_and_what_is_allowed(capsys):
    assert cli.main(["run", "velim_a1", "--set", "loop.tick_hz=17"]) == cli.USAGE
    printed = capsys.readouterr().err
    assert "tick_hz" in printed
    assert "100" in printed


@pytest.mark.parametrize(
    ("words", "allowed"),
    [
        (("campaign", "low_adhesion", "--workers", "-1"), "numbers from 1, or 0"),
        (("check", "--port", "70000"), "numbers from 0"),
        (("check", "--port", "-1"), "numbers from 0"),
        (("view", "RUN", "--png", "PICTURE", "--size", "0x600"), "at least 1 pixel"),
        (("view", "RUN", "--png", "PICTURE", "--size", "800x-1"), "at least 1 pixel"),
    ],
)
def test_a_number_that_an_option_does_not_allow_is_a_usage_error(
    words, allowed, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert cli.main(list(words)) == cli.USAGE
    assert allowed in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


def test_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit) as left:
        cli.main(["--version"])
    assert left.value.code == 0
    assert capsys.readouterr().out == f"rollerrig {metadata.version('rollerrig')}\n"


@pytest.mark.parametrize("kind", listing.KINDS)
def test_a_list_names_everything_of_a_kind_with_its_title(kind, capsys):
    assert cli.main(["list", kind, "--json"]) == cli.PASS
    named = json.loads(capsys.readouterr().out)[kind]
    assert all(one["name"] and one["title"] for one in named)
    if kind not in ("faults", "signals", "datasets"):
        packaged = [*store.names(kind), *store.names_of_vehicles(kind)]
        assert [one["name"] for one in named] == packaged


def test_the_list_of_faults_has_the_number_that_starts_each_over_modbus(capsys):
    assert cli.main(["list", "faults", "--json"]) == cli.PASS
    listed = json.loads(capsys.readouterr().out)["faults"]
    numbers = {fault["name"]: fault["modbus_number"] for fault in listed}
    assert numbers == {kind.name: kind.number for kind in catalogue.CATALOGUE}
    # the tutorial of Modbus starts this fault by its number
    tutorial = (Path(__file__).parents[2] / "docs/tutorial_modbus.md").read_text()
    assert f"Fault {numbers['vent_magnet_stuck']} is `vent_magnet_stuck`" in tutorial

    assert cli.main(["list", "faults"]) == cli.PASS
    printed = capsys.readouterr().out
    assert "Modbus number" in printed
    assert re.search(rf"\b{numbers['bus_off']}\W+bus_off\b", printed)


@pytest.mark.parametrize("kind", ["adhesion", "criteria", "vehicles"])
def test_a_title_in_a_list_is_a_whole_sentence(kind):
    for _, title in listing.names_and_titles(kind):
        assert title.count("(") == title.count(")"), title
        assert not title.endswith((",", ":")), title


def test_a_packaged_file_is_printed_as_it_is(capsys, tmp_path):
    assert cli.main(["list", "sequences", "--show", "emergency_120"]) == cli.PASS
    path = tmp_path / "my.toml"
    path.write_text(capsys.readouterr().out)
    packaged = store.find("sequences", "emergency_120").read_text()
    assert path.read_text() == packaged
    assert cli.main(["list", "sequences", "--show", "emergency_12"]) == cli.USAGE
    assert "did you mean 'emergency_120'" in capsys.readouterr().err
    assert cli.main(["list", "faults", "--show", "bus_off"]) == cli.USAGE
    assert "kinds with files: scenarios" in capsys.readouterr().err


def test_a_list_without_a_kind_lists_the_kinds(capsys):
    assert cli.main(["list", "--json"]) == cli.PASS
    kinds = json.loads(capsys.readouterr().out)["kinds"]
    assert tuple(kind["name"] for kind in kinds) == listing.KINDS
    assert all(kind["title"] for kind in kinds)


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("rnu", "velim_a1"), "run"),
        (("list", "scenario"), "scenarios"),
        (("run", "velim_a1", "--pacing", "Free"), "free"),
        (("campaign", "low_adhesion", "--worst", "stop_distance"), "stop_distance_m"),
        (("export", "RUN", "--format", "MDF4"), "mdf4"),
    ],
)
def test_a_misspelled_word_gets_a_suggestion(words, meant, free_stop, capsys):
    given = [str(free_stop.out) if word == "RUN" else word for word in words]
    try:
        status = cli.main(given)
    except SystemExit as exit_of_argparse:
        status = exit_of_argparse.code
    assert status == cli.USAGE
    assert f"did you mean '{meant}'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [("list", kind) for kind in listing.KINDS] + [("check",)], ids=" ".join
)
def test_a_narrow_terminal_folds_names_and_never_cuts_them(words, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    cli.main(list(words))
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 40
    assert "…" not in shown


def test_the_table_of_a_run_and_of_a_benchmark_fold_too(capsys):
    from rich.console import Console

    from rollerrig.realtime.benchmarks import figures
    from rollerrig.realtime.record import summary

    console = Console(width=40)
    console.print(
        figures.table("figures", ("what is measured", "figure"), [("a_long_name_" * 6, 1.0)])
    )
    console.print(summary.table(summary.of({"time_s": [0.0]}, {}, {})))
    shown = capsys.readouterr().out
    assert "…" not in shown
    assert shown.replace("\n", "").count("name") == 6


# it says so five times a second here
OFTEN = (
    "import sys; from rollerrig.realtime import cli; from rollerrig.realtime.commands import output; "
    "output.PERIOD_S = 0.2; sys.exit(cli.main(sys.argv[1:]))"
)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "words",
    [
        ("campaign", "low_adhesion"),
        pytest.param(("explain", "open_none"), marks=pytest.mark.nightly),
    ],
    ids=lambda words: words[0],
)
def test_long_work_on_a_pipe_says_now_and_then_how_far_it_is(words, tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", OFTEN, *words, "--out", str(tmp_path / "out")],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        said = ""
        for said in process.stderr:
            if re.search(r"\(\d+ s\)$", said):
                break
        process.kill()
    assert re.search(r"(runs|reading|%).*\(\d+ s\)$", said)


def test_explain_names_each_stage_and_shows_none_as_100_percent(monkeypatch, capsys):
    monkeypatch.setattr(output, "PERIOD_S", 0.01)

    def line_with(text):
        said = ""
        while text not in said:
            said += capsys.readouterr().err
            time.sleep(0.01)
        return said

    with explain.progress_bar() as progress:
        said = line_with("reading the data")
        for title in ("fit of causes", "null simulations", "fit of causes"):
            progress(title, 0.25)
            said += line_with(f"{title}: 25 %")
            progress(title, 0.999)
            said += line_with(f"{title}: 99 %")
            progress(title, 1.0)
            said += line_with(f"{title}: done, evaluating it")
    assert "100" not in said
    stages = dict.fromkeys(re.findall(r"stage (\d), ([a-z ]+):", said))
    assert list(stages) == [
        ("1", "fit of causes"),
        ("2", "null simulations"),
        ("3", "fit of causes"),
    ]


def test_sequences_on_a_pipe_show_name_and_speed_and_the_time_left(tmp_path):
    program = (
        "import sys; from rollerrig.realtime import cli;"
        "from rollerrig.realtime.commands import sequence;"
        "assert sequence.PERIOD_S >= 60.0; sequence.PERIOD_S = 0.05;"
        "sys.exit(cli.main(sys.argv[1:]))"
    )
    words = ("sequence", "emergency_040", "low_speed_010", "--jobs", "2")
    done = subprocess.run(
        [sys.executable, "-c", program, *words, "--out", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        check=True,
    )
    lines = re.findall(r"^\d of 2 sequences played.*", done.stderr, re.MULTILINE)
    assert any("emergency_040 starting" in line for line in lines)
    speeds_m_s = re.findall(r"emergency_040 (\d+\.\d) m/s", "\n".join(lines))
    assert float(speeds_m_s[0]) > float(speeds_m_s[-1])
    assert any(re.search(r"about \d+ (s|min) left \(\d+ s\)$", line) for line in lines)


def test_a_shell_completes_verbs(tmp_path):
    pytest.importorskip("argcomplete")
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": "rollerrig camp", "COMP_POINT": "14"}
    answer = tmp_path / "answer"
    subprocess.run(
        [sys.executable, "-m", "rollerrig.realtime.cli"],
        check=False,
        env=os.environ | asked | {"_ARGCOMPLETE_STDOUT_FILENAME": str(answer)},
    )
    assert "campaign" in answer.read_text()


@pytest.mark.parametrize(
    "words",
    [
        ("sequence", "emergency_120", "--out", "rep\udce9/o"),
        ("run", "velim_a1", "--out", "rep\udce9"),
        ("export", "rep\udce9", "--format", "csv"),
    ],
)
def test_a_name_that_is_not_utf_8_is_refused_before_anything_runs(
    words, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert cli.main(list(words)) == 2
    message = capsys.readouterr().err
    assert r"the name rep\xe9" in message
    assert "is not in UTF-8" in message
    assert list(tmp_path.iterdir()) == []
