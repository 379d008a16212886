"""Names and texts that can be written to every file and shown on every page."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from bayesreg.types import InputError

# Controls but for tabs and ends of lines, line separators that read back as others, and halves of characters.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\ufffe\uffff]")

# What stands where there is no number.
NONE = "–"


def find_unprintable(text: str) -> str | None:
    """The first character that cannot be printed, as U+0085; None where there is none."""
    found = _UNPRINTABLE.search(text)
    return None if found is None else f"U+{ord(found[0]):04X}"


def require_printable(names: Iterable[str], where: str) -> None:
    """Raise InputError, which begins with `where`, for a name that cannot be printed or has several lines."""
    for name in names:
        if (odd := find_unprintable(name)) is not None or "\n" in name:
            raise InputError(f"{where}: the name {name!r:.80} holds {odd or 'an end of line'}; give it another one")


def number(value: float | int | None, digits: int = 3) -> str:
    """A number to so many significant digits; a dash where there is none."""
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
