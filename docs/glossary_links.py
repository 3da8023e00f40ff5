"""The first use of a term of the glossary on a page is a link that shows the definition.

Pages contain no such links: this hook of mkdocs.yml adds them when the site is built. It reads the
terms from the tables of glossary.md, and gives each of them an anchor.
"""

import re
from pathlib import Path
from xml.etree import ElementTree

from markdown import Extension, Markdown
from markdown.treeprocessors import Treeprocessor
from markdown.util import AtomicString
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

PAGE = "glossary.md"
# a row of the glossary: terms with commas between them, and their meaning
ROW = re.compile(r"^\| (?!term \|)([^|]+) \| ([^|]+) \|$", re.MULTILINE)
MARKDOWN_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
# terms that pages also use as ordinary words
ORDINARY = {
    "application",
    "cause",
    "event",
    "f",
    "fill",
    "flat",
    "gain",
    "group",
    "hold",
    "measure",
    "node",
    "patch",
    "release",
    "unit",
    "valid",
    "vent",
}
# elements whose text stays as it is
WITHOUT_LINKS = {"a", "abbr", "code", "h1", "h2", "h3", "h4", "h5", "h6", "pre", "th"}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the extension that sets the links."""
    LINKS.read_definitions(Path(config.docs_dir) / PAGE)
    config.markdown_extensions.append(LINKS)  # type: ignore[arg-type]
    return config


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Prepare the extension for a page; in the glossary itself each term gets an anchor."""
    is_glossary = page.file.src_uri == PAGE
    # on a page of docstrings each of them would have a first use
    LINKS.active = not is_glossary and "\n::: " not in markdown
    return ROW.sub(_with_anchors, markdown) if is_glossary else markdown


def _with_anchors(row: re.Match[str]) -> str:
    """Return a row of the glossary in which each term has an anchor."""
    terms = [f'<span id="{anchor_of(term)}">{term}</span>' for term in row[1].split(", ")]
    return f"| {', '.join(terms)} | {row[2]} |"


def anchor_of(term: str) -> str:
    """Return the anchor of a term on the page of the glossary."""
    return re.sub(r"\W+", "-", term.lower())


class Links(Extension):
    """A Markdown extension. `active`: whether the page that is converted now gets links."""

    def __init__(self) -> None:
        super().__init__()
        self.active = False
        self.definitions: dict[str, str] = {}

    def read_definitions(self, glossary: Path) -> None:
        """Read the meaning of each term, as plain text."""
        for terms, meaning in ROW.findall(glossary.read_text(encoding="utf-8")):
            plain = MARKDOWN_LINK.sub(r"\1", meaning).replace("`", "")
            for term in terms.split(", "):
                if term not in ORDINARY:
                    self.definitions[term] = plain

    def extendMarkdown(self, md: Markdown) -> None:
        # after the inline patterns (20), and before MkDocs checks the links (0)
        md.treeprocessors.register(_Setter(md, self), "glossary_links", 5)


class _Setter(Treeprocessor):
    """Sets the links in the tree of one page."""

    def __init__(self, md: Markdown, links: Links) -> None:
        super().__init__(md)
        self.links = links
        self.definitions: dict[str, str] = {}  # of the terms that the page has not used yet

    def run(self, root: ElementTree.Element) -> None:
        if self.links.active:
            self.definitions = dict(self.links.definitions)
            self._visit(root)

    def _visit(self, element: ElementTree.Element) -> None:
        """Link the terms in an element, in the order of the page."""
        children = list(element)
        element.text, links = self._split(element.text)
        for place, link in enumerate(links):
            element.insert(place, link)

        for child in children:
            if child.tag == "code" and child.text in self.definitions:
                child = self._wrap(element, child)
            elif child.tag not in WITHOUT_LINKS:
                self._visit(child)
            child.tail, links = self._split(child.tail)
            behind = list(element).index(child) + 1
            for place, link in enumerate(links, behind):
                element.insert(place, link)

    def _split(self, text: str | None) -> tuple[str | None, list[ElementTree.Element]]:
        """Return the text before the first linked term, and the links, each with its tail."""
        if not text or isinstance(text, AtomicString):
            return text, []
        links: list[ElementTree.Element] = []
        before = text
        rest = text
        while found := self._next_term(rest):
            link = self._new_link(self._term_of(found[0]))
            link.text = AtomicString(found[0])
            if links:
                links[-1].tail = rest[: found.start()]
            else:
                before = rest[: found.start()]
            rest = rest[found.end() :]
            link.tail = rest
            links.append(link)
        return before, links

    def _next_term(self, text: str) -> re.Match[str] | None:
        """Return the first use of a term in a text, the longest of those that begin there."""
        if not self.definitions:
            return None
        longest_first = sorted(self.definitions, key=len, reverse=True)
        names = "|".join(map(_pattern, longest_first))
        return re.search(rf"(?<![\w/-])(?:{names})(?:s)?(?![\w/-])", text)

    def _term_of(self, word: str) -> str:
        """Return the term that a text uses: as it is, in lower case, or in the plural."""
        for form in (word, word.removesuffix("s")):
            for term in (form, form[:1].lower() + form[1:]):
                if term in self.definitions:
                    return term
        raise KeyError(word)

    def _wrap(self, parent: ElementTree.Element, code: ElementTree.Element) -> ElementTree.Element:
        """Return a link round a term in the type of code, which it replaces."""
        link = self._new_link(str(code.text))
        link.tail, code.tail = code.tail, None
        parent[list(parent).index(code)] = link
        link.append(code)
        return link

    def _new_link(self, term: str) -> ElementTree.Element:
        """Return a link to a term, which from now on counts as used."""
        title = self.definitions.pop(term)
        href = f"{PAGE}#{anchor_of(term)}"
        return ElementTree.Element("a", {"class": "term", "href": href, "title": title})


def _pattern(term: str) -> str:
    """Return the pattern of a term; a word may begin with a capital."""
    first, rest = re.escape(term[0]), re.escape(term[1:])
    if term[0].islower():
        return f"[{term[0]}{term[0].upper()}]{rest}"
    return first + rest


LINKS = Links()
