"""Check that names and texts can be written to every file and shown on every page, and format numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence

from bayesreg.types import InputError

# Control characters except tabs and ends of lines, line separators that programs read back as other characters, and
# halves of surrogate pairs.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\ufffe\uffff]")

# The text for a missing number.
NONE = "–"

# The greatest number of names in a sentence.
MOST_NAMED = 8


def find_unprintable(text: str) -> str | None:
    """Find the first character that cannot be printed, such as U+0085; None if all can be printed."""
    match = _UNPRINTABLE.search(text)
    return None if match is None else f"U+{ord(match[0]):04X}"


def require_printable(names: Iterable[str], where: str) -> None:
    """Raise InputError if a name cannot be printed or has several lines; its message begins with `where`."""
    for name in names:
        if (odd := find_unprintable(name)) is not None or "\n" in name:
            raise InputError(f"{where}: the name {name!r:.80} holds {odd or 'an end of line'}; give it another one")


def join_some(names: Sequence[str]) -> str:
    """Join names for a sentence; of many, the first ones."""
    return f"{', '.join(names[:MOST_NAMED])}{', …' * (len(names) > MOST_NAMED)}"


def number(value: float | int | None, digits: int = 3) -> str:
    """Format a number with `digits` significant digits; a missing or non-finite number becomes a dash."""
    if value is None or not math.isfinite(value):
        return NONE
    if value == 0:
        return "0"
    if not 1e-3 <= abs(value) < 1e7:
        return f"{value:.{digits - 1}g}".replace("e+", "e").replace("-", "−")
    if abs(value) >= 10**digits:
        return f"{value:,.0f}".replace("-", "−")
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}".replace("-", "−")


def place_text(place: Iterable[float]) -> str:
    """Format world coordinates, mm."""
    # Adding zero turns −0 into 0.
    return ("(" + ", ".join(f"{round(coordinate) + 0:d}" for coordinate in place) + ") mm").replace("-", "−")
