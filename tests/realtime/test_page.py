"""The page of every report escapes text, needs no other file, and suits a light or dark screen."""

import re

from rollerrig.realtime.pictures import colours
from rollerrig.realtime.reports import page, pdf


def draw_two_lines(figure):
    """Draw a line in the colour of the text, and one in the colour of axle 3."""
    plot = figure.subplots()
    plot.plot([0.0, 1.0], [0.0, 2.0], color=page.INK)
    plot.plot([0.0, 1.0], [2.0, 0.0], color=page.AXLES[2])
    plot.set(xlabel="time, s", ylabel="sliding, m/s")


def test_plain_text_is_escaped_and_markup_is_not():
    bold = page.element("b", "bold")
    text = page.page("a < b", page.paragraph("1 < 2 & ", bold, kind="note"))
    assert "<title>a &lt; b</title>" in text
    assert '<p class="note">1 &lt; 2 &amp; <b>bold</b></p>' in text


def test_a_page_needs_no_other_file_and_no_script():
    text = page.page("a picture", page.picture(draw_two_lines))
    assert not re.search(r'(src|href)="(https?:)?//', text)
    assert "<script" not in text


def test_the_name_of_a_file_cannot_make_a_link_the_address_of_a_script(tmp_path):
    link = page.file_link("run", tmp_path / "javascript:alert(1)" / "a#b?.svg", tmp_path)
    assert link == '<a href="./javascript%3Aalert%281%29/a%23b%3F.svg">run</a>'


def test_a_picture_has_its_words_as_text_in_the_colour_of_the_page():
    svg = page.picture(draw_two_lines)
    assert "sliding, m/s" in svg
    assert "time, s" in svg
    assert page.INK not in svg
    assert "currentColor" in svg
    assert colours.as_hex(colours.AXLES[2]) in svg


def test_the_same_data_give_the_same_picture():
    assert page.picture(draw_two_lines) == page.picture(draw_two_lines)


def test_numbers_are_aligned_to_the_right_and_words_to_the_left():
    rows = [("a", "1.5 m"), ("b", "-"), ("c", "+3 %")]
    html = page.table(("name", "value"), rows)
    assert html.count('<td class="number">') == 3
    assert '<th class="number">value</th>' in html
    assert "<th>name</th>" in html


def test_a_table_without_rows_is_empty():
    assert page.table(("name", "value"), []) == ""


def test_a_report_on_paper_is_a_pdf_with_its_pictures_and_tables(tmp_path):
    limit = page.element("small", "µ ≤ 1")
    measure = page.element("span", "lock", page.BREAK, limit)
    with page.on_paper():
        text = page.page(
            "a < b",
            page.facts({"unit under test": "ACME"}),
            page.picture(draw_two_lines),
            page.table(("measure", "result"), [(measure, "fail")], ["marked"]),
        )

    content = pdf.write(text, tmp_path / "report.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert b"/Image" in content
    assert b"DejaVuSans" in content
