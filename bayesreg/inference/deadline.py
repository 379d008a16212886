"""The time at which a search or a warm-up ends with the best result that it has."""

from __future__ import annotations

import math
import time
from typing import NamedTuple


class Deadline(NamedTuple):
    """A point in time.

    Attributes
    ----------
    end : float
        Seconds of `time.monotonic`; infinite without a budget.
    """

    end: float = math.inf

    @classmethod
    def after(cls, seconds: float | None) -> Deadline:
        """Make the deadline so many seconds from now; None is no budget."""
        return cls() if seconds is None else cls(time.monotonic() + seconds)

    @property
    def remaining(self) -> float:
        """The seconds that are left; negative after the deadline."""
        return self.end - time.monotonic()

    @property
    def has_passed(self) -> bool:
        """Whether the time is spent."""
        return self.remaining <= 0

    def require_time(self, *_: object) -> None:
        """Raise StopIteration if the time is spent; an optimiser of SciPy takes this as its callback."""
        if self.has_passed:
            raise StopIteration


NEVER = Deadline()
