"""The site of the documentation: it needs no internet, and what it adds to the pages works."""

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pictures
import pytest
from block_diagram import block_diagram
from chromium import browsing
from PIL import Image

pytest.importorskip("material", reason="the site needs the extra docs")

ROOT = Path(__file__).parent.parent
# attributes of elements by which a browser loads a file; only a reader follows the link of an `a`
LOADED = {"src", "srcset", "poster", "data"}
LINK_ELEMENTS = {"link", "use", "image"}
FROM_ELSEWHERE = re.compile(r"^\s*(?:[a-z]+:)?//", re.IGNORECASE)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "-d", str(folder)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return folder


class Loads(HTMLParser):
    """The addresses that a page loads when a browser shows it."""

    def __init__(self, text):
        super().__init__()
        self.addresses = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            loads = name in LOADED or (name == "href" and tag in LINK_ELEMENTS)
            if loads and value:
                self.addresses.append(value)


@pytest.mark.nightly
def test_no_page_loads_anything_from_the_internet(site):
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 30
    elsewhere = set()
    for page in pages:
        for address in Loads(page.read_text(encoding="utf-8")).addresses:
            if FROM_ELSEWHERE.match(address):
                elsewhere.add(f"{page.name}: {address}")
    assert elsewhere == set()


@pytest.mark.nightly
def test_no_style_sheet_loads_anything_from_the_internet(site):
    sheets = sorted(site.rglob("*.css"))
    assert sheets
    for sheet in sheets:
        loaded = re.findall(r"(?:url\(|@import )[\"']?([^\"')]+)", sheet.read_text("utf-8"))
        assert [address for address in loaded if FROM_ELSEWHERE.match(address)] == []


@pytest.mark.nightly
def test_the_search_works_without_a_server(site):
    with browsing() as browser:
        browser.get((site / "index.html").as_uri() + "?q=creepage")
        browser.implicitly_wait(20)
        first = browser.find_element("css selector", ".md-search-result__item a")
        address = first.get_attribute("href")
        assert address.startswith("file:")
        page = Path(unquote(urlsplit(address).path))
        assert page.parent == site
        assert "creepage" in page.read_text(encoding="utf-8")


@pytest.mark.nightly
def test_the_first_use_of_a_term_links_to_the_glossary_and_shows_its_meaning(site):
    text = (site / "units.html").read_text(encoding="utf-8")
    (link,) = re.findall(r'<a class="?term"? [^>]*glossary\.html#wsp"? [^>]*>WSP<', text)
    assert 'title="Wheel slide protection' in link
    glossary = (site / "glossary.html").read_text(encoding="utf-8")
    assert re.search(r'<span id="?wsp"?>WSP</span>', glossary)
    # the glossary does not link its terms to itself
    assert 'class="term"' not in glossary


@pytest.mark.nightly
def test_a_page_has_every_picture_in_light_and_in_dark(site):
    for page in sorted(site.rglob("*.html")):
        text = page.read_text(encoding="utf-8")
        assert text.count("#only-light") == text.count("#only-dark"), page.name


# --- pictures ---


def pictures_on_pages():
    """The pictures that the pages show, as paths."""
    shown = set()
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        text = page.read_text(encoding="utf-8")
        names = re.findall(r'(?:srcset|src)="([^"]+)"', text)
        names += re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
        shown |= {(page.parent / name).resolve() for name in names}
    return shown


def test_the_folder_of_pictures_has_what_the_pages_show_and_one_command_makes():
    files = set(pictures.FOLDER.iterdir())
    assert files == pictures_on_pages()
    made = "|".join(pictures.PICTURES)
    assert [path.name for path in files if not re.match(f"(?:{made})[-_.]", path.name)] == []


def test_a_picture_is_small_and_as_wide_as_a_page():
    for path in pictures.FOLDER.iterdir():
        assert path.stat().st_size < 1000 * pictures.LARGEST_KB, path.name
        if path.suffix == ".png":
            width = Image.open(path).width
            assert 0.95 * pictures.WIDTH < width <= 2 * pictures.WIDTH, path.name


def test_a_picture_in_light_has_one_in_dark():
    names = {path.name for path in pictures.FOLDER.iterdir()}
    light = {name for name in names if "-light." in name}
    assert light
    assert {name.replace("-light.", "-dark.") for name in light} == {
        name for name in names if "-dark." in name
    }


def test_the_block_diagram_is_up_to_date():
    for scheme in pictures.SCHEMES:
        path = pictures.FOLDER / f"rig-{scheme}.svg"
        drawn = block_diagram(dark=scheme == "dark")
        assert path.read_text(encoding="utf-8") == drawn, "run: make pictures PICTURES=rig"
