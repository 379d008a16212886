"""Blocks of draws, in memory or in a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Protocol, runtime_checkable

import numpy as np

Block = Mapping[str, np.ndarray]


@runtime_checkable
class Blocks(Protocol):
    """Blocks of draws in their order: a list, or what holds them elsewhere and hands out one at a time."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Block: ...

    def __iter__(self) -> Iterator[Block]: ...

    def append(self, block: Block, /) -> None:
        """Keep one block more."""
