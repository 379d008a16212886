"""Blocks of draws and the last state of a run, from which an interrupted run continues."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from bayesreg.io.atomic import load_arrays, save_arrays
from bayesreg.io.run_folder import ANEW, RunFolder, Stage
from bayesreg.types import AnyArray

STATE, DRAWS = "state.npz", "draws"


def save_block(folder: RunFolder, index: int, arrays: Mapping[str, AnyArray]) -> None:
    """Write one block of draws in one step; replace a block of the same index."""
    with folder.writing() as place:
        save_arrays(place(_block_name(index)), arrays)


class StoredBlocks:
    """The first `count` blocks of draws in draws/ of a run folder; each is read when it is needed (see `save_block`).

    Parameters
    ----------
    folder : RunFolder
    count : int

    Raises
    ------
    InputError
        If a block is missing or, when it is read, damaged.
    """

    def __init__(self, folder: RunFolder, count: int) -> None:
        self.folder, self.count = folder, count
        for index in range(count):
            self.folder.file(_block_name(index))

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int, /) -> dict[str, np.ndarray]:
        if not 0 <= index < self.count:
            raise IndexError(f"block {index} of {self.count}")
        return load_arrays(self.folder.file(_block_name(index)), ANEW)

    def __iter__(self) -> Iterator[dict[str, np.ndarray]]:
        return (self[index] for index in range(self.count))

    def append(self, block: Mapping[str, AnyArray], /) -> None:
        """Write one more block of draws."""
        save_block(self.folder, self.count, block)
        self.count += 1


def _block_name(index: int) -> str:
    return f"{DRAWS}/block_{index:05d}.npz"


def save_state(folder: RunFolder, arrays: Mapping[str, AnyArray], stage: Stage | None = None) -> None:
    """Replace state.npz, from which the next block starts, in one step; optionally set the run's stage with it."""
    with folder.writing(stage) as place:
        save_arrays(place(STATE), arrays)


def load_state(folder: RunFolder) -> dict[str, np.ndarray]:
    """Read state.npz; raise InputError if it is damaged, or if no chain has started yet."""
    return load_arrays(folder.file(STATE), ANEW)


def close(folder: RunFolder) -> None:
    """Remove draws/ of a run whose results are complete, and compress state.npz, from which the run can continue.

    Half of a triangular factor is zero. Compression takes too long for the state of a run that goes on.
    """
    state = load_state(folder)
    with folder.writing() as place:
        save_arrays(place(STATE), state, compressed=True)
    folder.drop(DRAWS)
    shutil.rmtree(folder.path / DRAWS, ignore_errors=True)


def reopen(folder: RunFolder, blocks: Iterable[Mapping[str, AnyArray]]) -> None:
    """Turn a finished run into an interrupted run that stopped after these blocks, which hold all its draws.

    If the process is killed between two steps, the folder holds either the finished run or the interrupted one.
    """
    state = load_state(folder)
    stored = StoredBlocks(folder, 0)
    for block in blocks:
        stored.append(block)
    save_state(folder, state | {"blocks": np.array(len(stored))}, "prepared")
