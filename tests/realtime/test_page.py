"""The page of every report: escaped, whole in itself, legible on light and on dark."""

import re

from rollerrig.realtime.pictures import colours
from rollerrig.realtime.reports import page, pdf


def draw(figure):
    plot = figure.subplots()
    plot.plot([0.0, 1.0], [0.0, 2.0], color=page.INK)
    plot.plot([0.0, 1.0], [2.0, 0.0], color=page.AXLES[2])
    plot.set(xlabel="time, s", ylabel="sliding, m/s")


def test_plain_text_is_escaped_and_markup_is_not():
    text = page.page("a < b", page.paragraph("1 < 2 & ", page.element("b", "bold"), kind="note"))
    assert "<title>a &lt; b</title>" in text
    assert '<p class="note">1 &lt; 2 &amp; <b>bold</b></p>' in text


def test_a_page_needs_nothing_from_elsewhere():
    text = page.page("a picture", page.picture(draw))
    assert not re.search(r'(src|href)="(https?:)?//', text)
    assert "<script" not in text


def test_a_picture_has_its_text_as_text_in_the_colour_of_the_page():
    text = page.picture(draw)
    assert "sliding, m/s" in text
    assert "time, s" in text
    assert page.INK not in text
    assert "currentColor" in text
    assert colours.as_hex(colours.AXLES[2]) in text


def test_the_same_data_give_the_same_picture():
    assert page.picture(draw) == page.picture(draw)


def test_numbers_stand_to_the_right_and_words_to_the_left():
    text = page.table(("name", "value"), [("a", "1.5 m"), ("b", "-"), ("c", "+3 %")])
    assert text.count('<td class="number">') == 3
    assert '<th class="number">value</th>' in text
    assert "<th>name</th>" in text


def test_a_table_without_rows_is_not_there():
    assert page.table(("name", "value"), []) == ""


def test_a_report_on_paper_is_a_pdf_with_its_pictures_and_tables(tmp_path):
    with page.on_paper():
        text = page.page(
            "a < b",
            page.facts({"unit under test": "ACME"}),
            page.picture(draw),
            page.table(
                ("measure", "result"),
                [
                    (
                        page.element("span", "lock", page.BREAK, page.element("small", "µ ≤ 1")),
                        "fail",
                    )
                ],
                ["marked"],
            ),
        )
    content = pdf.write(text, tmp_path / "report.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert b"/Image" in content
    assert b"DejaVuSans" in content
