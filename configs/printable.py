"""Text that leaves the program for a terminal, a page or an XML file, without hidden characters.

Names and texts of users may contain characters that nobody sees and that act: control characters
move the cursor of a terminal and colour it, marks of direction reorder what a reader sees, and XML
forbids most of them. They become visible here, as in `\\x1b`. JSON escapes them itself.
Source: Unicode 15, categories Cc, Cs and Cf; XML 1.0, production Char.
"""

import re

# All control characters except tab and line feed; soft hyphen, zero width space and marks of
# direction; separators of lines; invisible operators; byte order mark, annotations and what is no
# character; half surrogate pairs; tags. The joiners U+200C and U+200D stay: words and pictures need
# them.
_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad"
    "\u061c\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f"
    "\ufeff\ufff9-\ufffb\ufffe\uffff\ud800-\udfff"
    "\U000e0000-\U000e007f]"
)
# what a library for terminals writes itself: colours, movements of the cursor, begin of the line
_DRAWN = re.compile(r"(\x1b\[[0-9;?]*[A-Za-z]|\r)")


def printable(text: str) -> str:
    """Return a text in which hidden characters are visible, as in `\\x1b`."""
    return _HIDDEN.sub(_escaped, text)


def printable_drawing(text: str) -> str:
    """Return a text as `printable`, but with the sequences that draw on a terminal.

    It is for the output of a library that draws (rich), whose parts are printable already.
    """
    pieces = _DRAWN.split(text)
    # each second piece is a sequence
    pieces[::2] = [printable(piece) for piece in pieces[::2]]
    return "".join(pieces)


def _escaped(found: re.Match[str]) -> str:
    return found[0].encode("unicode_escape").decode()
