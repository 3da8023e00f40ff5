"""The page of trains: each of its commands runs, on the file that it lets its reader write."""

import os
import re
import shlex
import sys
from pathlib import Path

from rollerrig.realtime import cli
from rollerrig.realtime.commands import output
from rollerrig.realtime.record import records

PAGE = (Path(__file__).parents[3] / "docs" / "howto_train.md").read_text(encoding="utf-8")
FILE = re.search(r"^`my_train.toml`:\n\n((?: {4}.*\n|\n(?= {4}))+)", PAGE, re.MULTILINE)
COMMANDS = re.findall(r"^ {4}(rollerrig .+)$", PAGE, re.MULTILINE)


def test_the_commands_of_the_page_run_one_after_another(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # the page starts `rollerrig wsp` as a unit
    programs = Path(sys.executable).parent
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    assert FILE
    content = re.sub(r"^ {4}", "", FILE[1], flags=re.MULTILINE)
    Path("my_train.toml").write_text(content, encoding="utf-8")
    assert len(COMMANDS) >= 6
    for command in COMMANDS:
        words = shlex.split(command)[1:]
        assert cli.main(words) == output.PASS, command
        capsys.readouterr()
        if words[0] == "run":
            assert (Path(words[-1]) / "report.html").is_file()

    # the page quotes the result of its first run
    summary = records.summary(Path("runs/coaches"))
    quoted = f"in {summary['braking_time_s']:.2f} s and {summary['braking_distance_m']:.1f} m"
    assert quoted in PAGE
    alone_m = summary["alone"]["braking_distance_m"]
    assert f"its car 1 alone: {alone_m:.1f} m" in PAGE
    # the late brake has larger forces in its couplers
    forces = [
        max(abs(one["compression_max_N"]) for one in records.summary(Path(folder))["couplers"])
        for folder in ("runs/mine", "runs/late")
    ]
    assert forces[1] > 0.0
    assert forces[0] != forces[1]
