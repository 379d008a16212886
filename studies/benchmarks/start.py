"""How long does `bayesreg run` take to the first draw of a chain, if it ran once before?

    python -m studies.benchmarks.start CONFIG [--set KEY=VALUE …] [--runs 5]

The program runs the command as a user does, with two differences. This benchmark has its own folder of compiled
programs. Every block has one draw (sampler.block=1), so that a run stores its first draw at once; then the run is
killed. Give the mesh (--set mesh.file=…), because compiled programs fit one mesh.
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
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        first, *later = (
            seconds(arguments.config, arguments.overrides, Path(folder), number) for number in range(arguments.runs + 1)
        )
    print(f"{first:.1f} s with everything to compile; then {', '.join(f'{x:.1f}' for x in later)} s")
    print(f"median {np.median(later):.1f} s")


def seconds(config: str, overrides: list[str], folder: Path, number: int) -> float:
    """Measure the seconds until the first draw is stored."""
    out = folder / f"run_{number}"
    options = [argument for override in [*overrides, "sampler.block=1"] for argument in ("--set", override)]
    command = [sys.executable, "-c", "from bayesreg.cli import main; main()", "run", config, "-o", str(out)]
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache")}
    began = time.perf_counter()
    with subprocess.Popen([*command, *options, "--quiet"], env=environment) as process:
        while not (out / "draws" / "block_00000.npz").exists():
            if process.poll() is not None:
                sys.exit(f"the run ended with status {process.returncode} before its first draw")
            time.sleep(0.02)
        took = time.perf_counter() - began
        process.kill()
    return took


if __name__ == "__main__":
    main()
