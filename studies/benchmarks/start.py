"""Seconds from the command `bayesreg run` to the first draw of a chain, when it was run once before.

    python -m studies.benchmarks.start CONFIG [--set KEY=VALUE …] [--runs 5]

Everything as a user has it, compiled programs kept in a folder of this benchmark, but that every draw is a block of its
own (sampler.block), so that the first is on the disk when it is made; there the run is ended. The mesh is to be given
(--set mesh.file=…): programs are kept for one.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def main() -> None:
    """Print the seconds of every run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--runs", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        first, *later = (
            seconds(given.config, given.overrides, Path(folder), number) for number in range(given.runs + 1)
        )
    print(f"{first:.1f} s with everything to compile; then {', '.join(f'{x:.1f}' for x in later)} s")
    print(f"median {np.median(later):.1f} s")


def seconds(config: str, overrides: list[str], folder: Path, number: int) -> float:
    """Until the first draw is kept."""
    out = folder / f"run_{number}"
    words = [word for override in [*overrides, "sampler.block=1"] for word in ("--set", override)]
    command = [sys.executable, "-c", "from bayesreg.cli import main; main()", "run", config, "-o", str(out)]
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache")}
    began = time.perf_counter()
    with subprocess.Popen([*command, *words, "--quiet"], env=environment) as process:
        while not (out / "draws" / "block_00000.npz").exists():
            if process.poll() is not None:
                sys.exit(f"the run ended with status {process.returncode} before its first draw")
            time.sleep(0.02)
        took = time.perf_counter() - began
        process.kill()
    return took


if __name__ == "__main__":
    main()
