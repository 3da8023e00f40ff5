"""The pages of the site that are at the root of the repository, and its links and pictures.

Pages are written for a code hosting page. For the site this hook of mkdocs.yml changes two things:

- A link to a page is turned to where the site has that page. A link to a file that is no page
  becomes plain text. A link to nothing stays as it is, and `mkdocs build --strict` refuses it.
- A `<picture>` with a light and a dark image becomes two images, of which the theme shows one.

Docstrings are read from a folder of links, which has the modules as the installed package has them.
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
PICTURE = re.compile(
    r'<picture>\s*<source[^>]*srcset="(?P<dark>[^"]+)"[^>]*>'
    r'\s*<img(?=[^>]*alt="(?P<alt>[^"]+)")[^>]*src="(?P<light>[^"]+)"[^>]*>\s*</picture>'
)


# the package `rollerrig`: its file, and its folders
PACKAGE_FILE = ROOT / "realtime" / "api" / "__init__.py"
PACKAGE_FOLDERS = ("configs", "firmware_sim", "realtime", "rig", "wsp_interface")


def on_startup(**_: object) -> None:
    """Make the folder of links from which docstrings are read; mkdocs.yml names it."""
    package = ROOT / "build" / "package" / "rollerrig"
    package.mkdir(parents=True, exist_ok=True)
    for name in PACKAGE_FOLDERS:
        link = package / name
        link.unlink(missing_ok=True)
        link.symlink_to(ROOT / name)
    # no link: the other modules are next to this file, and not next to its target
    (package / "__init__.py").write_bytes(PACKAGE_FILE.read_bytes())


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from the root of the repository."""
    for page, name in AT_ROOT.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """A page with its links and pictures as the site has them."""
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

    return LINK.sub(link, PICTURE.sub(_light_and_dark, markdown))


def _light_and_dark(found: re.Match[str]) -> str:
    """Return the two images of a `<picture>`."""
    alt, light, dark = found["alt"], found["light"], found["dark"]
    return f"![{alt}]({light}#only-light)\n![{alt}]({dark}#only-dark)"
