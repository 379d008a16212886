"""Where does the time of a run go? Measure seconds of the wall clock by stage and by kind of work.

    python -m studies.profile RUN [-o OUT] [--set KEY=VALUE …]

RUN is a YAML configuration, or a run folder whose configuration is run again. The run goes to OUT, by default to a
temporary folder. A second thread looks at the Python stack of the run a hundred times a second. The outermost known
function on the stack tells the stage, and the innermost one the kind of work. Compiled code does not show on the stack:
the seconds belong to the Python function that waits for it. A compiled block of draws is therefore one kind of work,
gradients and normaliser together; `studies.benchmarks.parts` splits it. Programs are compiled anew unless --kept.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import FrameType, MappingProxyType

INTERVAL = 0.01
STARTING = "start, imports"
# Stages by the functions that they call, from the first to the last. A function inside another stage is more specific.
STAGES: Mapping[str, str] = MappingProxyType({
    "prepared_inputs": "images",
    "build_mesh": "mesh",
    "make_pair": "synthetic pair",
    "posterior_of": "posterior",
    "temper": "first search",
    "search_modes": "search",
    "average_gaussian": "Gaussians",
    "tune": "warm-up",
    "first_checkpoint": "start of the chains",
    "_sample": "draws",
    "judge": "convergence",
    "finish": "results",
    "write_report": "report",
})  # fmt: skip
# Kinds of work by a fragment of the path and the name of a function, if it is not empty. Compilation comes first,
# because it calls the functions of all other kinds.
COMPILATION = (
    ("jax/_src/compiler.py", ""),
    ("jax/_src/interpreters/mlir.py", ""),
    ("jax/_src/interpreters/partial_eval.py", ""),
    ("jax/_src/interpreters/pxla.py", "lower_sharding_computation"),
)
KINDS = (
    ("normaliser", "gaussian/density.py", "normaliser_and_slope"),
    ("normaliser", "gaussian/normaliser.py", ""),
    ("gradients", "gaussian/density.py", ""),
    ("gradients", "gaussian/warm_up.py", ""),
    ("gradients", "chains/block.py", ""),
    ("gradients", "chains/run.py", "_advance"),
    ("host algebra", "inference/gaussian/", ""),
    ("host algebra", "model/curvature.py", ""),
    ("host algebra", "scipy/linalg/", ""),
    ("host algebra", "numpy/linalg/", ""),
    ("cells", "fem/location.py", ""),
    ("figures", "matplotlib/", ""),
    ("figures", "plotly/", ""),
    ("files", "nibabel/", ""),
    ("files", "h5py/", ""),
    ("files", "xarray/backends/", ""),
    ("files", "bayesreg/io/", ""),
    ("fTetWild", "pytetwild/", ""),
)
COMPILING, OTHER = "compilation", "other"


class StackSampler(threading.Thread):
    """A thread that looks at the stack of the main thread every `INTERVAL` seconds.

    Attributes
    ----------
    seconds : Counter
        The seconds by (stage, kind).
    """

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.seconds: Counter[tuple[str, str]] = Counter()
        self.main, self.ended = threading.main_thread().ident, threading.Event()

    def run(self) -> None:
        """Count until `stop` is called; each look counts for the time since the look before."""
        before = time.perf_counter()
        while not self.ended.wait(INTERVAL):
            frames = list(_stack(sys._current_frames()[self.main]))
            now = time.perf_counter()
            self.seconds[stage_of(frames), kind_of(frames)] += now - before
            before = now

    def stop(self) -> None:
        """Stop counting, and wait for the end of the thread."""
        self.ended.set()
        self.join()


def _stack(frame: FrameType | None) -> Iterator[tuple[str, str]]:
    """List the file and the function of each frame, the innermost first."""
    while frame is not None:
        yield frame.f_code.co_filename, frame.f_code.co_name
        frame = frame.f_back


def stage_of(frames: list[tuple[str, str]]) -> str:
    """Name the stage of the innermost function of `STAGES` in a stack."""
    names = (name for path, name in frames if "bayesreg/" in path)
    return next((STAGES[name] for name in names if name in STAGES), STARTING)


def kind_of(frames: list[tuple[str, str]]) -> str:
    """Name the kind of work of the innermost known function in a stack."""
    if any(_matches(frame, fragment, name) for frame in frames for fragment, name in COMPILATION):
        return COMPILING
    kinds = (kind for frame in frames for kind, fragment, name in KINDS if _matches(frame, fragment, name))
    return next(kinds, OTHER)


def _matches(frame: tuple[str, str], fragment: str, name: str) -> bool:
    return fragment in frame[0] and name in ("", frame[1])


def show(seconds: Mapping[tuple[str, str], float]) -> None:
    """Print a table of seconds with a row for each stage and a column for each kind of work."""
    from rich.console import Console

    from bayesreg.report.tables import Table
    from studies.terminal import in_terminal

    stages = [stage for stage in (STARTING, *STAGES.values()) if any(key[0] == stage for key in seconds)]
    totals = Counter[str]()
    for (_, kind), value in seconds.items():
        totals[kind] += value
    kinds = [kind for kind, _ in totals.most_common()]
    rows = [[stage, *_row([seconds.get((stage, kind), 0.0) for kind in kinds])] for stage in stages]
    rows.append(["all", *_row([totals[kind] for kind in kinds])])
    table = Table("Seconds of the wall clock", "", ["stage", "all", *kinds], [("", rows)])
    Console(width=160).print(in_terminal(table))


def _row(values: list[float]) -> list[str]:
    return [f"{value:.1f}" if value >= 0.05 else "" for value in (sum(values), *values)]


def main() -> None:
    """Run a configuration and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN", help="a YAML configuration, or a run folder")
    parser.add_argument("-o", "--out", type=Path, help="the folder of the new run")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--kept", action="store_true", help="use the programs that earlier runs compiled")
    arguments = parser.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if not arguments.kept:
            os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
        config = arguments.run / "config.yaml" if arguments.run.is_dir() else arguments.run
        options = [option for override in arguments.overrides for option in ("--set", override)]
        sampler = StackSampler()
        sampler.start()
        from bayesreg.cli import main as bayesreg

        sys.argv = ["bayesreg", "run", str(config), "-o", str(arguments.out or folder / "run"), *options]
        try:
            bayesreg()
        except SystemExit as ended:
            print(f"the run ended with status {ended.code}")
        sampler.stop()
    show(sampler.seconds)


if __name__ == "__main__":
    main()
