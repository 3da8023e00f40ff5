"""Reports: one file, the same verdicts three times, and no pass where something went wrong."""

import dataclasses
import io
import itertools
import json
import re
import xml.etree.ElementTree as ET
from html import escape
from pathlib import Path

import numpy as np
import pytest
import synthetic_record
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from pypdf import PdfReader
from synthetic_record import GOOD

from rollerrig.configs import store
from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.commands import sequence as verb_sequence
from rollerrig.realtime.reports import page as report_page
from rollerrig.realtime.reports import pdf, sequences, stop
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.harness_client import Event
from rollerrig.wsp_interface.sequences import measures, sequence, verdict
from rollerrig.wsp_interface.sequences.play import Outcome
from rollerrig.wsp_interface.sequences.verdict import Result


def outcome(folder, text=GOOD, **changes):
    path = folder / "one.toml"
    path.write_text(text, encoding="utf-8")
    found = Outcome(
        sequence.load(path, catalogue.parse),
        folder / "one",
        events=[
            Event(
                1.0,
                "step",
                "brake <hard> & fast",
                Code.SEQUENCE_STEP,
                {"title": "brake <hard> & fast"},
            )
        ],
    )
    found.record = synthetic_record.record()
    found.verdicts = verdict.judge(found.sequence.criteria, found.record)
    for name, value in changes.items():
        setattr(found, name, value)
    return found


def test_the_page_needs_nothing_from_elsewhere(tmp_path):
    page = sequences.write([outcome(tmp_path)], tmp_path / "out")[0].read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(https?:)?//', page)
    assert "<script" not in page
    assert "not a certification" in page.lower()
    assert page.count("<svg") == 1
    assert all(unit in page for unit in ("speeds, km/h", "brake cylinders, bar", "time, s"))
    assert "brake &lt;hard&gt; &amp; fast" in page


def test_the_page_names_the_source_of_every_limit(tmp_path):
    found = outcome(tmp_path)
    page = sequences.html([found], tmp_path, sequences.datetime.now(sequences.UTC))
    for limit in found.sequence.criteria.limits:
        for words in verdict.source_words(limit.source):
            assert escape(words) in page


@pytest.mark.parametrize(
    ("source", "heading", "rest"),
    [
        (
            "recollection, to be checked against EN 15595: up to 0.4 s",
            "from memory, not verified against EN 15595",
            "up to 0.4 s",
        ),
        (
            "recollection of typical units, to be checked against UIC 541-05: 1.3",
            "from memory of typical units, not verified against UIC 541-05",
            "1.3",
        ),
        (
            "recollection, to be checked against EN 15595",
            "from memory, not verified against EN 15595",
            "",
        ),
        (
            "recollection, to be checked against EN 15595:2018+A1:2023: which tests",
            "from memory, not verified against EN 15595:2018+A1:2023",
            "which tests",
        ),
        ("assumption: a tenth", "assumption", "a tenth"),
        (
            "EN 15595, clause 7",
            "EN 15595, as the criteria profile states; not verified",
            "EN 15595, clause 7",
        ),
        ("no wheel slides", "", "no wheel slides"),
    ],
)
def test_a_source_from_memory_says_so_before_it_names_a_standard(source, heading, rest):
    assert verdict.source_words(source) == (heading, rest)


def test_no_packaged_limit_claims_a_standard_that_nobody_has_verified():
    for path in Path(store.__file__).parent.joinpath("criteria").glob("*.toml"):
        for limit in verdict.load(str(path)).limits:
            heading, _ = verdict.source_words(limit.source)
            assert not re.fullmatch(r"(EN|UIC|ISO|IEC) ?[\d-]+", heading)
            if "EN 15595" in limit.source:
                assert heading == "from memory, not verified against EN 15595"


def test_the_page_says_what_was_tested_by_whom_and_what_each_axle_did(tmp_path):
    found = outcome(tmp_path)
    page = sequences.html(
        [found], tmp_path, sequences.datetime.now(sequences.UTC), {"tested by": "A. Meier"}
    )
    assert all(
        text in page
        for text in (
            "A. Meier",
            "unit under test",
            "72 km/h",
            "uic_z1",
            "43 t",
            "slip, %",
            "Longest lock",
            "<b>assumption</b>",
            "<b>from memory, not verified against EN 15595</b>",
            "document number",
            "revision",
            "Signatures",
            "approved by",
        )
    )
    assert (
        page.count('<tr class="marked">') == 2
    )  # in the list of sequences, and among its measures
    rows = stop.axles(found.record)[1]
    assert [row[4] for row in rows] == ["0.00", "0.50", "0.00", "0.00", "-", "-", "-", "-"]
    assert rows[1][3] == "100"  # % of slip while it was locked
    assert [text for _, kind, text in sequences.marks(found) if kind == stop.STEP] == [
        "brake <hard> & fast"
    ]


def test_what_sensors_measured_is_in_separate_rows_of_the_page(tmp_path):
    found = outcome(tmp_path)
    # the sensor of axle 3 shows nothing from 8 s on
    dead = found.record.columns["time_s"] > 8.0
    found.record.columns["measured_speed_3_rad_s"][dead] = 0.0
    head, rows, classes = stop.axles(found.record)
    largest_m_s = head.index("largest, m/s")
    assert rows[2][0] == "3"
    assert rows[2][largest_m_s] == "0.00"
    assert rows[6][0] == "3, as measured"
    assert float(rows[6][largest_m_s]) == pytest.approx(13.0, abs=0.03)
    assert classes == [""] * 4 + ["void"] * 4
    page = sequences.html([found], tmp_path, sequences.datetime.now(sequences.UTC))
    assert "3, as measured" in page
    data = sequences.as_data([found], sequences.datetime.now(sequences.UTC))["sequences"][0]
    assert data["figures"]["sliding_max"] == pytest.approx(16.0, abs=0.1)  # axle 2 locks
    assert data["measured"]["sliding_mean"] > data["figures"]["sliding_mean"] + 1.0


def test_the_conditions_of_a_sequence_have_the_gradient(tmp_path):
    level = outcome(tmp_path)
    downhill = outcome(tmp_path)
    mechanisms = downhill.record.scenario["mechanisms"] | {"track_gradient_gradient": -0.01}
    scenario = downhill.record.scenario | {"mechanisms": mechanisms}
    downhill.record = dataclasses.replace(downhill.record, scenario=scenario)
    when = sequences.datetime.now(sequences.UTC)
    assert "<th>gradient</th><td>0 % (level)</td>" in sequences.html([level], tmp_path, when)
    assert "<th>gradient</th><td>-1 % (downhill)</td>" in sequences.html([downhill], tmp_path, when)
    (data,) = sequences.as_data([downhill], when)["sequences"]
    assert data["conditions"]["gradient"] == "-1 % (downhill)"


def test_the_report_has_the_values_of_keys_and_not_their_names(tmp_path):
    found = outcome(tmp_path)
    page = sequences.html([found], tmp_path, sequences.datetime.now(sequences.UTC))
    assert "longest lock of a wheelset above 3 m/s" in page
    assert "longest lock above 3 m/s, s</th>" in page
    for measure in measures.MEASURES:
        assert "_m_s" not in measure.meaning(found.record)


def test_a_sequence_with_limits_but_without_a_profile_is_not_reported_as_one_without_limits(
    tmp_path,
):
    limits = '[[measure]]\nmeasure = "stop_time"\nunit = "s"\nmax = 60.0\nsource = "assumption"\n'
    without = GOOD.replace('criteria = "stop"', 'criteria = "none"')
    when = sequences.datetime.now(sequences.UTC)
    page = sequences.html([outcome(tmp_path, without + limits)], tmp_path, when)
    assert "criteria: limits in the sequence ·" in page
    page = sequences.html([outcome(tmp_path, without)], tmp_path, when)
    assert "criteria: no limits ·" in page
    page = sequences.html([outcome(tmp_path, GOOD + limits)], tmp_path, when)
    assert "criteria: stop (stops on low adhesion; and limits in the sequence) ·" in page


def test_the_states_of_nodes_before_and_after_the_test_do_not_fill_the_events(tmp_path):
    found = outcome(tmp_path)
    end_s = float(found.record.columns["time_s"][-1])
    for time_s, state in ((0.0, "starting"), (5.0, "pre-operational"), (end_s, "stopped")):
        fields = {"node": 17, "state": state}
        found.events.append(Event(time_s, "bench, info", f"is {state}", Code.NMT_STATE, fields))
    page = sequences.html([found], tmp_path, sequences.datetime.now(sequences.UTC))
    assert "is pre-operational" in page  # perhaps the effect of a fault
    assert "is starting" not in page
    assert "is stopped" not in page
    assert "2 events (2 NMT states before and after the test are only in events.jsonl)" in page


def test_measures_are_void_where_a_precondition_failed(tmp_path):
    found = outcome(tmp_path)
    found.verdicts = verdict.judge(
        found.sequence.criteria, found.record, "a pre-condition was not met"
    )
    assert all(
        one.void and one.result is Result.ABSENT and one.value_text == "" for one in found.verdicts
    )
    assert found.result is Result.ERROR


def test_junit_and_json_tell_the_same_as_the_verdicts(tmp_path):
    found = outcome(tmp_path)
    _, data_path, junit_path = sequences.write([found], tmp_path / "out")
    data, suite = json.loads(data_path.read_text()), ET.parse(junit_path).getroot()[0]
    failed = [one.what for one in found.verdicts if one.result is Result.FAIL]
    assert failed
    assert [
        one["what"] for one in data["sequences"][0]["verdicts"] if one["result"] == "fail"
    ] == failed
    assert len(suite.findall(".//failure")) == int(suite.get("failures")) == len(failed)
    assert int(suite.get("tests")) == len(found.verdicts)
    assert data["result"] == "fail"
    names = [case.get("name") for case in suite.iter("testcase")]
    assert "longest_lock: at most 0.4 s" in names
    assert "deceleration_shortfall: at most 0.8 m/s2" in names
    assert "(at most 0.4 s)" in suite.findall(".//failure")[0].get("message")


def test_a_bench_that_vanished_is_an_error_however_good_the_rest_was(tmp_path):
    found = outcome(tmp_path, error="the bench has gone \x07", verdicts=[])
    assert found.result is Result.ERROR
    assert sequences.overall([found]) is Result.ERROR
    suite = ET.fromstring(sequences.junit_xml([found]).partition("\n")[2])[0]
    assert suite.get("errors") == "1"
    assert "the bench has gone" in sequences.html(
        [found], tmp_path, sequences.datetime.now(sequences.UTC)
    )


def test_a_report_that_cannot_be_written_says_so(tmp_path):
    in_the_way = tmp_path / "out"
    in_the_way.write_text("a file")
    with pytest.raises(RollerrigError, match="cannot be written"):
        sequences.write([outcome(tmp_path)], in_the_way)


def test_what_nobody_expected_is_an_error_of_its_own_sequence(tmp_path):
    good = outcome(tmp_path)

    def breaks():
        raise ZeroDivisionError("a bug")

    found = verb_sequence._outcome_or_error(breaks, good.sequence, tmp_path)
    assert found.result is Result.ERROR
    assert "a bug" in found.error
    assert verb_sequence._outcome_or_error(lambda: good, good.sequence, tmp_path) is good


# --- paper ---


def outlines(content):
    """Return the titles of the bookmarks of a PDF file."""
    reader = PdfReader(io.BytesIO(content))
    titles = []
    for entry in reader.outline:
        nested = entry if isinstance(entry, list) else [entry]
        titles += [one.title for one in nested]
    return titles


def test_a_report_on_paper_has_a_title_bookmarks_page_numbers_and_room_to_sign(tmp_path):
    about = {"document number": "ACME-0815", "revision": "C", "tested by": "A. Meier"}
    paths = sequences.write([outcome(tmp_path)], tmp_path / "out", about=about, on_paper=True)
    content = paths[-1].read_bytes()
    reader = PdfReader(io.BytesIO(content))
    assert reader.metadata.title == "WSP test sequences on the roller rig"
    titles = outlines(content)
    assert titles[0] == "WSP test sequences on the roller rig"
    assert any("A stop from forty on soap" in title for title in titles)
    assert "Signatures" in titles
    for number, sheet in enumerate(reader.pages, start=1):
        text = sheet.extract_text()
        assert f"page {number} of {len(reader.pages)}" in text
        assert "document number: ACME-0815" in text
        assert "revision: C" in text
    last = reader.pages[-1].extract_text()
    assert all(words in last for words in ("tested by", "A. Meier", "approved by", "signature"))


@pytest.mark.parametrize("rows", [None, 0, 1, 2])
def test_a_run_that_broke_off_has_a_report_on_paper_too(tmp_path, rows):
    found = outcome(tmp_path, error="the bench has gone", verdicts=[])
    if rows is None:
        found.record = None
    else:
        columns = {name: values[:rows] for name, values in found.record.columns.items()}
        found.record = dataclasses.replace(found.record, columns=columns)
    paths = sequences.write([found], tmp_path / "out", on_paper=True)
    assert [path.name for path in paths] == [
        sequences.HTML,
        sequences.JSON,
        sequences.JUNIT,
        sequences.PDF,
    ]
    text = "".join(
        sheet.extract_text() for sheet in PdfReader(io.BytesIO(paths[-1].read_bytes())).pages
    )
    assert "the bench has gone" in text


def test_names_of_marks_do_not_overlap_and_stay_in_the_picture(tmp_path):
    record = outcome(tmp_path).record
    marks = [
        stop.Mark(0.2 + 0.4 * number, stop.FAULT, f"speed_sensor_stuck axle={number} for=3 lifted")
        for number in range(1, 6)
    ]
    marks += [stop.Mark(20.9, stop.STEP, "the driver releases the brake, and the train rolls on")]
    figure = Figure(figsize=(11.0, 9.5), layout="constrained")
    FigureCanvasAgg(figure)
    stop.draw(figure, stop.motion_of_record(record), marks)
    figure.canvas.draw()
    names = {mark.name for mark in marks}
    boxes = [
        text.get_window_extent() for text in figure.findobj(Annotation) if text.get_text() in names
    ]
    assert len(boxes) == len(marks)
    for first, second in itertools.combinations(boxes, 2):
        assert not first.overlaps(second)
    for box in boxes:
        assert box.x0 >= 0.0
        assert box.x1 <= figure.bbox.width


# every character that XML 1.0 forbids, colours of a terminal, and a mark that reorders text
HIDDEN = "".join(map(chr, [*range(9), 11, 12, *range(14, 32), 0x7F, 0x85, 0x202E, 0xFFFE]))


def test_control_characters_in_titles_are_visible_in_every_report(tmp_path):
    title = f"A stop \x1b[31mwith colours\x1b[0m {HIDDEN}"
    escaped = json.dumps(title)
    text = re.sub(r'(?m)^title = ".*"$', lambda _: f"title = {escaped}", GOOD, count=1)
    assert escaped in text
    found = outcome(tmp_path, text)
    found.verdicts = [dataclasses.replace(found.verdicts[0], what=title, text=title)]
    out = tmp_path / "out"
    sequences.write([found], out, on_paper=True)

    tree = ET.parse(out / sequences.JUNIT)
    names = [case.get("name") for case in tree.iter("testcase")]
    assert any(r"A stop \x1b[31mwith colours\x1b[0m \x00\x01" in name for name in names)
    for name in (sequences.JUNIT, sequences.HTML):
        written = (out / name).read_text(encoding="utf-8")
        assert not set(HIDDEN) & set(written), name
        assert r"\x1b[31m" in written
    on_paper = "".join(one.extract_text() for one in PdfReader(out / sequences.PDF).pages)
    assert r"\x1b[31m" in on_paper
    assert "\x1b" not in on_paper
    assert json.loads((out / sequences.JSON).read_text(encoding="utf-8"))["result"]


def test_the_field_case_of_a_coloured_title_is_read_and_reported(tmp_path):
    field = Path(__file__).parent.parent / "data" / "field" / "junit" / "title_esc.toml"
    found = outcome(tmp_path)
    found.sequence = sequence.load(field, catalogue.parse)
    assert "\x1b" in found.sequence.title
    sequences.write([found], tmp_path / "out")
    assert ET.parse(tmp_path / "out" / sequences.JUNIT).getroot().tag == "testsuites"


def with_changed_friction(found):
    """Return a stop whose rail changes at 100 m and at 500 m, and by a step at 3 s."""
    by_place = [
        {"mu_cd": 0.015, "mu_cr": 0.28, "axles": [1, 2], "from_m": 100.0},
        {"mu_cd": 0.1, "mu_cr": 0.28, "axles": [1, 2, 3, 4], "from_m": 500.0},
    ]
    adhesion = found.record.scenario["adhesion"] | {"mu_cr": 0.28}
    scenario = found.record.scenario | {"friction": by_place, "adhesion": adhesion}
    found.record = dataclasses.replace(found.record, scenario=scenario)
    fields = {"mu": 0.02, "axles": [3]}
    found.events.append(Event(3.0, "harness", "friction", Code.TEST_FRICTION, fields))
    return found


def test_a_changed_rail_is_among_the_conditions_of_a_report_and_a_line_in_its_picture(tmp_path):
    found = with_changed_friction(outcome(tmp_path))
    when = sequences.datetime.now(sequences.UTC)
    changed = (
        "mu_cd 0.015 under axles 1 and 2, from 100 m; "
        "mu_cd 0.1 under all axles, from 500 m (not reached); "
        "mu_cd 0.02 under axle 3, by command at 3.00 s"
    )
    (data,) = sequences.as_data([found], when)["sequences"]
    assert data["conditions"]["changed friction"] == changed
    html = sequences.html([found], tmp_path, when)
    assert f"<th>changed friction</th><td>{changed}</td>" in html

    marks = [mark for mark in sequences.marks(found) if mark.kind == stop.FRICTION]
    assert [mark.name for mark in marks] == [
        "mu_cd 0.02 under axle 3",
        "mu_cd 0.015 under axles 1 and 2",
    ]
    position_m = found.record.columns["position_m"]
    at_place = found.record.columns["time_s"] == marks[1].time_s
    assert position_m[at_place] == pytest.approx(100.0, abs=0.2)
    # the picture names each of them
    assert all(mark.name in html.split("<svg")[1] for mark in marks)


def test_a_report_of_a_constant_rail_has_no_row_of_changed_friction(tmp_path):
    when = sequences.datetime.now(sequences.UTC)
    (data,) = sequences.as_data([outcome(tmp_path)], when)["sequences"]
    assert "changed friction" not in data["conditions"]


def test_the_picture_has_a_line_where_a_fault_begins_and_where_it_is_lifted(tmp_path):
    found = outcome(tmp_path)
    text = "vent_magnet_dead axle=3"
    commanded = {"fault": f"{text} for=4"}
    found.events.append(Event(5.0, "harness", "fault", Code.TEST_FAULT, commanded))
    words = "vent magnet dead, axle 3"
    expected = [(5.0, words), (9.0, f"{words} lifted")]

    def faults():
        return [mark for mark in sequences.marks(found) if mark.kind == stop.FAULT]

    # a bench that ran already reports no events: the command says how long the fault lasts
    assert [mark.time_s for mark in faults()] == [5.0, 9.0]
    fields = {"fault": text, "kind": "vent_magnet_dead", "reaches_unit": False, "units": []}
    for time_s, code in ((5.0, Code.FAULT_BEGINS), (9.0, Code.FAULT_LIFTED)):
        found.events.append(Event(time_s, "bench", "fault", code, fields))
    assert [(mark.time_s, mark.name) for mark in faults()] == expected


@pytest.mark.parametrize("time_s", [0.5, 5.0, 19.0])
def test_the_name_of_a_mark_begins_or_ends_at_its_line(tmp_path, time_s):
    record = outcome(tmp_path).record
    mark = stop.Mark(time_s, stop.FAULT, "vent_magnet_dead axle=3 lifted, and the brake goes on")
    figure = Figure(figsize=(11.0, 9.5), layout="constrained")
    FigureCanvasAgg(figure)
    stop.draw(figure, stop.motion_of_record(record), [mark])
    figure.canvas.draw()
    (name,) = (text for text in figure.findobj(Annotation) if text.get_text() == mark.name)
    box = name.get_window_extent()
    line_x, _ = name.axes.transData.transform((time_s, 0.0))
    # the room of a name has a reserve for another font
    room = 1.2 * box.width
    assert abs(box.x0 - line_x) < 2.0 or 0.0 <= line_x - box.x1 <= room - box.width


def test_a_slip_of_100_percent_without_a_lock_is_explained_next_to_the_table_of_axles(tmp_path):
    when = sequences.datetime.now(sequences.UTC)
    html = sequences.html([outcome(tmp_path)], tmp_path, when)
    assert "a wheel that locks below 3 m/s has a slip of 100 % and no lock" in html


def test_a_step_without_a_value_has_no_blank_before_its_comma():
    step = verdict.Verdict(
        what="leaves under axles 1 and 2",
        unit="",
        value=float("nan"),
        limit="any sliding > 1 m/s",
        margin=float("nan"),
        result=Result.FAIL,
        source="the sequence",
        text="",
    )
    assert step.against_limit == "leaves under axles 1 and 2, wanted any sliding > 1 m/s"


# a row with words that were broken, next to cells with much text
NARROW = (
    "Air consumption",
    "every cylinder_pressure > 1 bar",
    "1.5 NL",
    *["a long text " * 12] * 5,
)


def test_no_word_of_a_table_breaks_but_a_long_one_such_as_a_path(tmp_path):
    long_path = "/home/engineer/" + "reports/of/the/contract/" * 8
    table = report_page.table(
        ("measure", "expected", "value", "a", "b", "c", "d", "e"),
        [NARROW, (long_path, *NARROW[1:])],
    )
    assert "<td>Air consumption</td>" in table
    assert f'<td class="long">{long_path}</td>' in table

    with report_page.on_paper():
        pdf.write(report_page.page("A title", table), tmp_path / "report.pdf")
    sheets = PdfReader(tmp_path / "report.pdf").pages
    words = " ".join(sheet.extract_text() for sheet in sheets).split()
    assert {"consumption", "cylinder_pressure", "expected"} <= set(words)


def test_bold_text_of_a_page_is_bold_on_paper_and_asterisks_of_a_user_stay(tmp_path):
    heading = report_page.element("b", "from memory, not verified")
    cell = report_page.element("span", heading, report_page.BREAK, "of a user: **x** __y__")
    table = report_page.table(("measure", "source"), [("sliding", cell), ("lock", cell)])
    paragraph = report_page.paragraph(report_page.element("b", "Warning: "), "plain text **x**")
    with report_page.on_paper():
        pdf.write(report_page.page("A title", table, paragraph), tmp_path / "report.pdf")

    fonts = {}

    def note_font(text, _matrix, _text_matrix, font, _size):
        for word in text.split():
            fonts.setdefault(word, set()).add("Bold" in font["/BaseFont"])

    (sheet,) = PdfReader(tmp_path / "report.pdf").pages
    sheet.extract_text(visitor_text=note_font)
    assert fonts["memory,"] == {True}
    assert fonts["Warning:"] == {True}
    assert fonts["plain"] == fonts["user:"] == fonts["sliding"] == {False}
    assert fonts["**x**"] == fonts["__y__"] == {False}


def test_a_heading_with_bold_text_has_no_character_without_a_glyph(tmp_path, caplog):
    heading = report_page.element("h2", "An emergency brake · ", report_page.element("b", "pass"))
    with report_page.on_paper():
        pdf.write(report_page.page("A title", heading), tmp_path / "report.pdf")
    assert "missing" not in caplog.text
    (sheet,) = PdfReader(tmp_path / "report.pdf").pages
    assert "An emergency brake · pass" in sheet.extract_text()


@pytest.mark.parametrize("lines_above", range(30, 60, 3))
def test_a_table_of_axles_is_on_one_page(tmp_path, lines_above):
    rows = [[f"axle_{axle}", "1.25", "a text of some length"] for axle in range(1, 10)]
    above = [report_page.paragraph("a line above")] * lines_above
    table = report_page.table(("axle", "mean", "text"), rows)
    with report_page.on_paper():
        pdf.write(report_page.page("A title", *above, table), tmp_path / "report.pdf")
    sheets = [sheet.extract_text() for sheet in PdfReader(tmp_path / "report.pdf").pages]
    assert sum("axle_" in sheet for sheet in sheets) == 1


def test_each_kind_of_line_in_the_picture_of_a_stop_has_an_entry_in_the_legend():
    time_s = np.linspace(0.0, 10.0, 50)
    falling_m_s = 30.0 - 3.0 * time_s

    def column(name):
        if name == "time_s":
            return time_s
        if name.startswith("measured"):
            return 0.5 * falling_m_s
        return falling_m_s

    figure = Figure()
    marks = [stop.Mark(2.0, kind, kind) for kind in (stop.STEP, stop.FAULT, stop.FRICTION)]
    stop.draw(figure, stop.Motion(COACH, column, 0.46), marks)
    (legend,) = figure.legends
    entries = [text.get_text() for text in legend.get_texts()]
    assert len(entries) == len(set(entries))
    for line in figure.axes[0].get_lines():
        label = line.get_label()
        is_mark = len(line.get_xdata()) == 2
        assert is_mark or label in entries
    assert {"step of the test", "measured speed, where it differs"} <= set(entries)
    assert {"fault begins, or is lifted", "friction of the rail changes"} <= set(entries)
