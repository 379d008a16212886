"""What bayesreg says while it works: records of `logging` under the name bayesreg, shown on the terminal by Rich."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import rich

_log = logging.getLogger("bayesreg")


class TerminalHandler(logging.Handler):
    """Prints messages as they are, above a progress bar where there is one; a warning begins with "beware"."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one message."""
        beware = "beware: " if record.levelno >= logging.WARNING else ""
        rich.get_console().print(beware + self.format(record), markup=False, highlight=False, soft_wrap=True)


@contextmanager
def show_messages() -> Iterator[None]:
    """Show messages in this block, unless they are shown already."""
    if any(isinstance(handler, TerminalHandler) for handler in _log.handlers):
        yield
        return
    handler = TerminalHandler()
    _log.addHandler(handler)
    try:
        with from_level(logging.INFO):
            yield
    finally:
        _log.removeHandler(handler)


@contextmanager
def from_level(level: int) -> Iterator[None]:
    """Drop messages below a level of `logging` in this block."""
    before = _log.level
    _log.setLevel(level)
    try:
        yield
    finally:
        _log.setLevel(before)
