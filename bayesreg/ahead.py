"""Work in another thread, while the main thread does work that does not need it yet.

Most steps before the first draw keep one core busy: meshing, the search for a pose, compilation. JAX finds a program
that another thread has compiled for arguments of the same shapes.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from typing import Any

_log = logging.getLogger(__name__)


@contextmanager
def ahead(steps: Iterable[Any]) -> Iterator[Future]:
    """Take steps in another thread while a block runs, and wait for their end after the block.

    An exception in the block does not wait: the steps that have not begun are left out. The step in hand goes on, and
    Python waits for it at its own end.

    Parameters
    ----------
    steps : iterable
        Its iteration is the work: a step for each element.

    Yields
    ------
    Future
        Its `result()` is the last element, or raises the error of a step; nothing else does. Work that the block's
        thread would do itself, such as compilation, needs no result.
    """
    done, abandoned = Future[Any](), threading.Event()

    def work() -> None:
        result = None
        try:
            for element in steps:
                result = element
                if abandoned.is_set():
                    break
        # Any error ends the work, and nobody may wait for its result.
        except BaseException as error:
            _log.debug("work ahead: %s", error)
            done.set_exception(error)
        else:
            done.set_result(result)

    # At the end of a process, a daemon within a call of XLA aborts it.
    threading.Thread(target=work, name=__name__).start()
    try:
        yield done
        wait([done])
    finally:
        abandoned.set()


def works_still() -> bool:
    """Report whether a step in another thread goes on."""
    return any(thread.name == __name__ for thread in threading.enumerate())
