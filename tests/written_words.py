"""Counts the words of the documents that people write, without what is generated.

    python tests/written_words.py                # words by page, and their sum

Generated are whole pages and tables that `make docs` writes, sections that a benchmark writes with
`--markdown`, and the table of measured data that `rig/identify/measured_page.py` writes.
"""

import re
from pathlib import Path

import written_docs
import written_reference

ROOT = Path(__file__).parent.parent
GENERATED_PAGES = {
    "conformance.md",
    "events.md",
    "faults.md",
    "licences.md",
    *written_reference.PAGES,
}
# heads of tables that programs outside of `make docs` write
OTHER_TABLES = {
    "measured.md": ("| set | known independently | what `explain` answers | judged |",),
    "compiled_kernels.md": ("| trick | task | with, s | without, s | saved, s |",),
}
# a section that a benchmark writes begins with the date and the machine of its measurement
MEASURED_SECTION = re.compile(r"^## .+\n\n20\d\d-\d\d-\d\d, (?:.*\n)+?(?=## |\Z)", re.MULTILINE)


def documents() -> list[Path]:
    """Return the pages whose words are counted."""
    pages = sorted((ROOT / "docs").glob("*.md"))
    return [*pages, ROOT / "CHANGELOG.md", ROOT / "DECISIONS.md"]


def written(path: Path) -> int:
    """Return the number of words of a page, without what is generated."""
    if path.name in GENERATED_PAGES:
        return 0
    text = path.read_text(encoding="utf-8")
    heads = (*written_docs.TABLES.get(path.name, ()), *OTHER_TABLES.get(path.name, ()))
    for head in heads:
        table = re.compile(rf"^{re.escape(head)}\n(?:\|.*\n)+", re.MULTILINE)
        text = table.sub("", text)
    text = MEASURED_SECTION.sub("", text)
    return len(text.split())


def main() -> None:
    """Print the words of each page, all and without what is generated."""
    counts = [(path, len(path.read_text("utf-8").split()), written(path)) for path in documents()]
    for path, words, by_hand in counts:
        print(f"{words:7} {by_hand:7}  {path.relative_to(ROOT)}")
    print(f"{sum(row[1] for row in counts):7} {sum(row[2] for row in counts):7}  all")


if __name__ == "__main__":
    main()
