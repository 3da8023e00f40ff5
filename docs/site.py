"""The pages of the site that stand at the root of the repository, and the links between all pages.

Links are written as the repository has them, so they work on a code hosting page. Here a link to a
page is turned to where the site has that page; one to a file that is no page becomes plain text. A
link to nothing stays as it is, and `mkdocs build --strict` refuses it. Loaded by mkdocs.yml.
"""

import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
# page of the site -> file of the repository
AT_ROOT = {
    "index.md": "README.md",
    **{name: name for name in ("SECURITY.md", "CONTRIBUTING.md", "CHANGELOG.md", "DECISIONS.md")},
}
LINK = re.compile(r"(!?\[([^\]]*)\])\(([^)\s#:]*)(#[^)\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from the root of the repository."""
    for page, name in AT_ROOT.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """A page with its links as the site has them."""
    at = page.file.src_uri
    folder = os.path.dirname(AT_ROOT.get(at, f"docs/{at}"))
    of_site = {name: place for place, name in AT_ROOT.items()}

    def link(found: re.Match[str]) -> str:
        label, text, target, anchor = found.groups()
        if not target:
            return found[0]
        name = os.path.normpath(os.path.join(folder, target))
        place = of_site.get(name, name.removeprefix("docs/"))
        if place in files.src_uris:
            return f"{label}({os.path.relpath(place, os.path.dirname(at) or '.')}{anchor or ''})"
        return text if (ROOT / name).exists() else found[0]

    return LINK.sub(link, markdown)
