"""Work in another thread, while the main thread does work that does not need it yet.

Most steps before the first draw keep one core busy: meshing, the search for a pose, compilation. JAX finds a program
that another thread has compiled for arguments of the same shapes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any


@contextmanager
def ahead(work: Callable[..., Any], *arguments: Any) -> Iterator[Future]:
    """Do some work in another thread while a block runs, and wait for its end after the block.

    An exception in the block does not wait for the work.

    Yields
    ------
    Future
        Its `result()` is the result of the work.
    """
    pool = ThreadPoolExecutor(max_workers=1)
    done = pool.submit(work, *arguments)
    try:
        yield done
        done.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
