"""Damage each file of an interrupted run and of a finished run in turn, and use the run afterwards.

    python -m studies.endurance.damage -o DIR

Each file is truncated, emptied and deleted, and one of its bits is flipped. Then the interrupted run is resumed. The
finished run is opened with its draws, resumed, reported again, and resumed with a greater budget. The result must be
that of an undamaged folder, or one InputError. Otherwise the program ends with status 1.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import bayesreg as br
from bayesreg.io import checkpoints
from bayesreg.io.run_folder import RunFolder
from bayesreg.types import InputError
from bayesreg.workflow.reports import report
from studies.endurance.kill import contents
from studies.endurance.small_run import write_pair

MIDDLE = 4


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    place = np.random.default_rng(len(content)).integers(len(content))
    content[place] ^= 1 << int(place % 8)
    path.write_bytes(bytes(content))


DAMAGES: dict[str, Callable[[Path], None]] = {
    "truncated": truncate, "emptied": empty, "deleted": Path.unlink, "one bit turned": flip,
}  # fmt: skip


def quick_reports() -> Any:
    """Replace reports by one word, because the figures take longer than these runs."""
    return mock.patch("bayesreg.report.html.write_report", lambda *arguments: arguments[-1].write_text("report"))


def interrupt(config: Path, out: Path) -> None:
    """Interrupt a run after `MIDDLE` blocks."""
    save = checkpoints.save_state

    def cut_off(folder: RunFolder, arrays: dict[str, np.ndarray], *rest: object) -> None:
        save(folder, arrays, *rest)
        if arrays["blocks"] == MIDDLE:
            raise KeyboardInterrupt

    with mock.patch.object(checkpoints, "save_state", cut_off):
        try:
            br.run(config, out, progress=False)
        except KeyboardInterrupt:
            return
    raise AssertionError("the run has ended")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    arguments = parser.parse_args()
    config = write_pair(arguments.out, steps=160)
    longer_config = br.load_config(config, ["stop.max_steps=200"])
    for name in ("finished", "interrupted", "longer"):
        shutil.rmtree(arguments.out / name, ignore_errors=True)
    with quick_reports():
        br.run(config, arguments.out / "finished", progress=False)
        interrupt(config, arguments.out / "interrupted")
        br.run(longer_config, arguments.out / "longer", progress=False)
    expected, longer = (contents(arguments.out / name / "posterior.nc") for name in ("finished", "longer"))

    def resume(folder: Path) -> bool:
        br.run(config, folder, resume=True, progress=False)
        return contents(folder / "posterior.nc") == expected

    def open_result(folder: Path) -> bool:
        result = br.load_result(folder)
        return bool(result.idata.posterior.sizes["draw"]) and contents(folder / "posterior.nc") == expected

    def draw_more(folder: Path) -> bool:
        br.run(longer_config, folder, resume=True, progress=False)
        return contents(folder / "posterior.nc") == longer

    def report_anew(folder: Path) -> bool:
        return report(folder).is_file()

    failures = 0
    trials = {"interrupted": [resume], "finished": [open_result, resume, report_anew, draw_more]}
    with quick_reports():
        for state, checks in trials.items():
            files = sorted(path.relative_to(arguments.out / state) for path in (arguments.out / state).rglob("*"))
            for file in files:
                if not (arguments.out / state / file).is_file() or file.name == ".lock":
                    continue
                for damage, spoil in DAMAGES.items():
                    for check in checks:
                        folder = arguments.out / "damaged"
                        shutil.rmtree(folder, ignore_errors=True)
                        shutil.copytree(arguments.out / state, folder)
                        if (folder / file).stat().st_size:
                            spoil(folder / file)
                        try:
                            outcome = "sound" if check(folder) else "WRONG NUMBERS"
                        except InputError as error:
                            outcome = f"InputError: {str(error).replace(str(folder), 'DIR')}"
                        except Exception as error:
                            outcome = f"TRACEBACK: {error!r}"
                        failures += outcome.startswith(("WRONG", "TRACE"))
                        print(f"{state} {file} {damage}, {check.__name__}: {outcome}", flush=True)
    print(f"{failures} failed")
    return int(failures > 0)


if __name__ == "__main__":
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", ".jax_cache")
    sys.exit(main())
