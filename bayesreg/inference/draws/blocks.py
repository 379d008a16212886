"""Blocks of draws, in memory or in a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Protocol, runtime_checkable

import numpy as np

Block = Mapping[str, np.ndarray]


@runtime_checkable
class Blocks(Protocol):
    """A sequence of blocks of draws: a list, or an object that reads one block at a time."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Block: ...

    def __iter__(self) -> Iterator[Block]: ...

    def append(self, block: Block, /) -> None:
        """Append a block of draws."""
