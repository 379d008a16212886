"""The share of sampling that keeping draws and state takes, so that a run that is cut off loses one block.

    python -m studies.benchmarks.checkpoint_cost CONFIG [--set KEY=VALUE …]

A run from end to end, as the command line makes it. Sampling is all that lies between the first block and the last,
which compiles; keeping is what comes between a block and the next: its file, that of the state, and the list of files
(twice each), all flushed to the operating system, as a kill of the process survives it.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from unittest import mock

import numpy as np

from bayesreg.config import load_config
from bayesreg.io import checkpoints
from bayesreg.workflow import run as module


def main() -> None:
    """Print the share."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    kept: list[float] = []
    ends: list[float] = []
    append, save = checkpoints.StoredBlocks.append, checkpoints.save_state

    def timed(what, *arguments):
        began = time.perf_counter()
        what(*arguments)
        kept.append(time.perf_counter() - began)

    def keep(*arguments):
        timed(save, *arguments)
        ends.append(time.perf_counter())

    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.object(checkpoints.StoredBlocks, "append", lambda *arguments: timed(append, *arguments)),
        mock.patch.object(checkpoints, "save_state", keep),
    ):
        module.run(load_config(given.config, given.overrides), Path(folder) / "run", progress=False)
    # The first state is that before any draw; of each block the draws are kept, and then the state.
    blocks = np.array(kept[1:]).reshape(-1, 2).sum(axis=1)
    whole = ends[-1] - ends[1]
    print(
        f"{len(blocks)} blocks: {blocks[1:].sum() / whole:.2%} of {whole:.0f} s; "
        f"{1e3 * np.median(blocks):.1f} ms a block, the last {1e3 * blocks[-1]:.1f}"
    )


if __name__ == "__main__":
    main()
