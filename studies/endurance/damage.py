"""Damage each file of an interrupted and of a finished run in turn, and look what is made of that.

    python -m studies.endurance.damage -o DIR

Each is truncated, emptied, deleted, and has one byte turned. Then an interrupted run is resumed; a finished one is
opened with its draws, gets its report anew, and is given a greater budget. What comes of it must be what comes of a
folder that is sound, or one InputError. Its status is 1 where it is not.
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
    """Reports of one word: the pictures take longer than these runs."""
    return mock.patch("bayesreg.report.html.write_report", lambda *arguments: arguments[-1].write_text("report"))


def interrupt(config: Path, out: Path) -> None:
    """Leave a run after some blocks."""
    save = checkpoints.save_state

    def cut_off(where: RunFolder, arrays: dict[str, np.ndarray], *rest: object) -> None:
        save(where, arrays, *rest)
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
    given = parser.parse_args()
    config = write_pair(given.out, steps=160)
    more = br.load_config(config, ["stop.max_steps=200"])
    for name in ("finished", "interrupted", "longer"):
        shutil.rmtree(given.out / name, ignore_errors=True)
    with quick_reports():
        br.run(config, given.out / "finished", progress=False)
        interrupt(config, given.out / "interrupted")
        br.run(more, given.out / "longer", progress=False)
    expected, longer = (contents(given.out / name / "posterior.nc") for name in ("finished", "longer"))

    def resume(folder: Path) -> bool:
        br.run(config, folder, resume=True, progress=False)
        return contents(folder / "posterior.nc") == expected

    def open_result(folder: Path) -> bool:
        result = br.load_result(folder)
        return bool(result.idata.posterior.sizes["draw"]) and contents(folder / "posterior.nc") == expected

    def draw_more(folder: Path) -> bool:
        br.run(more, folder, resume=True, progress=False)
        return contents(folder / "posterior.nc") == longer

    def report_anew(folder: Path) -> bool:
        return report(folder).is_file()

    failures = 0
    trials = {"interrupted": [resume], "finished": [open_result, resume, report_anew, draw_more]}
    with quick_reports():
        for state, looks in trials.items():
            files = sorted(path.relative_to(given.out / state) for path in (given.out / state).rglob("*"))
            for file in files:
                if not (given.out / state / file).is_file() or file.name == ".lock":
                    continue
                for damage, spoil in DAMAGES.items():
                    for look in looks:
                        folder = given.out / "damaged"
                        shutil.rmtree(folder, ignore_errors=True)
                        shutil.copytree(given.out / state, folder)
                        if (folder / file).stat().st_size:
                            spoil(folder / file)
                        try:
                            told = "sound" if look(folder) else "WRONG NUMBERS"
                        except InputError as error:
                            told = f"told: {str(error).replace(str(folder), 'DIR')}"
                        except Exception as error:
                            told = f"TRACEBACK: {error!r}"
                        failures += told.startswith(("WRONG", "TRACE"))
                        print(f"{state} {file} {damage}, {look.__name__}: {told}", flush=True)
    print(f"{failures} failed")
    return int(failures > 0)


if __name__ == "__main__":
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", ".jax_cache")
    sys.exit(main())
