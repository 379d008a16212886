"""End a run after its current block of draws if Ctrl-C or a queue's SIGTERM asks for it."""

from __future__ import annotations

import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_log = logging.getLogger(__name__)

# Seconds after which a signal is sent again.
AGAIN = 0.5
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """A signal ended the program; the stored run can be resumed.

    Parameters
    ----------
    number : int
        The number of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = int(number)

    @property
    def status(self) -> int:
        """The exit status of the program: 128 plus the signal's number, the convention of shells."""
        return 128 + self.number


@contextmanager
def ending_between_blocks() -> Iterator[Callable[[], None]]:
    """Delay the first signal until a block of draws is stored; a second signal ends the program at once.

    Yields
    ------
    callable
        Call it after a block is stored; it raises `Interrupted` if a signal came.
    """
    came: list[int] = []

    def note(number: int, _frame: object) -> None:
        if came:
            raise Interrupted(number)
        came.append(number)
        _log.info("the run ends after the draws in hand; another signal ends it at once")

    def require_none() -> None:
        if came:
            raise Interrupted(came[0])

    with _handling(note):
        yield require_none


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Let signals raise `Interrupted` at once.

    Python drops an exception that is raised in a callback of its garbage collector (JAX has one) or in a `__del__`.
    Therefore the signal is sent again until this block ends.
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
    # Python allows signal handlers in the main thread only.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield
    finally:
        for number, previous_handler in before.items():
            signal.signal(number, previous_handler)
