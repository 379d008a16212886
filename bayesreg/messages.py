"""Show the messages of bayesreg on the terminal: Rich prints the `logging` records of the logger bayesreg."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import rich

_log = logging.getLogger("bayesreg")


class TerminalHandler(logging.Handler):
    """Handler that prints messages without markup, above any progress bar; a warning begins with "warning:"."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one message on the terminal."""
        prefix = "warning: " if record.levelno >= logging.WARNING else ""
        rich.get_console().print(prefix + self.format(record), markup=False, highlight=False, soft_wrap=True)


@contextmanager
def show_messages() -> Iterator[None]:
    """Show messages in this block, unless an outer block shows them already."""
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
