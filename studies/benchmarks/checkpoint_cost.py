"""Which share of the sampling time does the storing of draws and state take?

    python -m studies.benchmarks.checkpoint_cost CONFIG [--set KEY=VALUE …]

The program makes a complete run, as the command line does. The sampling time is the time from the end of the first
block, which compiles, to the end of the last. After each block a run writes the file of the block and the file of the
state, and twice the list of files. All are flushed to the operating system, so that a killed run loses at most one
block.
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
    """Print the share of the sampling time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args()
    keeping_seconds: list[float] = []
    ends: list[float] = []
    append, save = checkpoints.StoredBlocks.append, checkpoints.save_state

    def timed(function, *arguments):
        began = time.perf_counter()
        function(*arguments)
        keeping_seconds.append(time.perf_counter() - began)

    def keep(*arguments):
        timed(save, *arguments)
        ends.append(time.perf_counter())

    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.object(checkpoints.StoredBlocks, "append", lambda *arguments: timed(append, *arguments)),
        mock.patch.object(checkpoints, "save_state", keep),
    ):
        module.run(load_config(options.config, options.overrides), Path(folder) / "run", progress=False)
    # The first state is written before any draw. Each block writes its draws, then the state.
    blocks = np.array(keeping_seconds[1:]).reshape(-1, 2).sum(axis=1)
    sampling_seconds = ends[-1] - ends[1]
    print(
        f"{len(blocks)} blocks: {blocks[1:].sum() / sampling_seconds:.2%} of {sampling_seconds:.0f} s; "
        f"{1e3 * np.median(blocks):.1f} ms a block, the last {1e3 * blocks[-1]:.1f}"
    )


if __name__ == "__main__":
    main()
