"""The page of measured data has a row for each public set, and its answers are held against what is
known."""

import re
from pathlib import Path

import measured_page
import pytest
from tiers import first_of

PAGE = Path(__file__).parents[3] / "docs" / "measured.md"


def test_the_page_has_a_row_for_each_set_and_each_set_of_other_people_is_on_the_page():
    text = PAGE.read_text()
    rows = re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)
    assert rows == [one.folder for one in measured_page.SETS]
    folders = {path.name for path in measured_page.MEASURED.iterdir() if path.is_dir()}
    public = {name for name in folders if name.endswith(("_mit", "_apache"))}
    assert public <= set(rows)


def test_each_public_set_has_its_source_and_licence_in_the_readme():
    readme = (measured_page.MEASURED / "README.md").read_text()
    for one in measured_page.SETS:
        if one.folder.endswith(("_mit", "_apache")):
            row = next(line for line in readme.splitlines() if f"`{one.folder}`" in line)
            assert "MIT" in row or "Apache-2.0" in row


@pytest.mark.parametrize("folder", first_of(["terramech_grouser_mit", "kingston_obd_mit"]))
def test_an_answer_on_a_public_set_is_right(folder, tmp_path):
    one = next(one for one in measured_page.SETS if one.folder == folder)
    result = measured_page.explain(folder, tmp_path)
    assert one.judge(result).startswith("right")
    assert one.known()


def test_a_wrong_answer_is_judged_wrong():
    reported = {"name": "falling_friction", "parameters": {"fall": {"ci95": [0.1, 0.2]}}}
    result = {"verdict": "explained", "causes": [reported], "law": {"fits": False}, "unknown": None}
    assert measured_page.judge_sand(result) == "wrong: falling_friction"
    assert measured_page.judge_locomotive(result).startswith("partly")
    assert measured_page.judge_robot(result).startswith("wrong")
    assert measured_page.judge_obd("obd_gap_mit")(result | {"causes": []}).startswith("partly")
