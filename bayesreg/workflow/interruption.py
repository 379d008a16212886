"""A run that is asked to end, by Ctrl-C or by a queue's SIGTERM, ends after the block of draws in hand."""

from __future__ import annotations

import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_log = logging.getLogger(__name__)

# Seconds after which a signal comes again.
AGAIN = 0.5
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """A signal has ended the program, and what is stored can be gone on with.

    Parameters
    ----------
    number : int
        Of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = int(number)

    @property
    def status(self) -> int:
        """The status that the program ends with: 128 and the signal's number, as shells have it."""
        return 128 + self.number


@contextmanager
def ending_between_blocks() -> Iterator[Callable[[], None]]:
    """Put signals off while blocks of draws are made; another one ends the program at once.

    Yields
    ------
    callable
        To be called where a block is stored; it raises `Interrupted` where a signal has come.
    """
    came: list[int] = []

    def note(number: int, _frame: object) -> None:
        if came:
            raise Interrupted(number)
        came.append(number)
        _log.info("the run ends after this block of draws; another signal ends it at once")

    def require_none() -> None:
        if came:
            raise Interrupted(came[0])

    with _handling(note):
        yield require_none


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Let signals raise `Interrupted`, where that is not lost.

    Python drops what is raised in a callback of its garbage collector (JAX has one) or in a `__del__`: the signal comes
    again, until this block has ended.
    """
    again: list[threading.Timer] = []
    show = sys.unraisablehook

    def stop(number: int, _frame: object) -> None:
        again.append(threading.Timer(AGAIN, signal.raise_signal, [number]))
        again[-1].daemon = True
        again[-1].start()
        raise Interrupted(number)

    def show_others(dropped: Any) -> None:
        if not isinstance(dropped.exc_value, Interrupted):
            show(dropped)

    with _handling(stop):
        sys.unraisablehook = show_others
        try:
            yield
        finally:
            sys.unraisablehook = show
            for timer in again:
                timer.cancel()


@contextmanager
def _handling(handler: Callable[[int, object], None]) -> Iterator[None]:
    # Only there can a program say what signals do.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield
    finally:
        for number, known in before.items():
            signal.signal(number, known)
