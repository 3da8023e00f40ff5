"""Numbers as a reader of a table expects them: rounded, and without an exponent."""

import math

# a smaller number keeps its exponent: its zeros could not be counted
_LEAST = 1e-7
# a larger number does, too
_MOST = 1e15


def rounded(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits, as in 106700 and not 1.067e+05."""
    text = f"{value:.{digits}g}"
    if "e" not in text or not _LEAST <= abs(value) < _MOST:
        return text
    places = digits - 1 - math.floor(math.log10(abs(value)))
    written = f"{float(text):.{max(places, 0)}f}"
    return written.rstrip("0").rstrip(".") if "." in written else written
