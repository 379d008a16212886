"""A cohort of small subjects, some of them broken, of whose workers one is killed again and again.

    python -m studies.endurance.cohort -o DIR [--subjects 24] [--external]

24 subjects on three workers, one of which is killed twice, and three broken subjects: 21 right results, three named
failures, and nothing that had ended is run twice. With --external the workers are those of a scheduler that this
program starts. Its status is 1 where that is not so.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pandas as pd
from ruamel.yaml import YAML

import bayesreg as br
from bayesreg.io.run_folder import RunFolder, digest_of
from bayesreg.workflow.batch import batch
from studies.endurance.damage import quick_reports
from studies.endurance.kill import contents
from studies.endurance.small_run import write_pair

BROKEN = {"data.fixed": "none.nii.gz", "data.moving": "damaged.nii.gz", "sampler.chains": "0"}


def write_cohort(folder: Path, subjects: int, workers: int, steps: int) -> Path:
    """The files of a cohort, whose last three subjects are broken each in its own way; the path of its file."""
    write_pair(folder, steps)
    rows = [{"subject": f"s{k:02d}", "seed": str(k)} for k in range(subjects)]
    if subjects > len(BROKEN):
        (folder / "damaged.nii.gz").write_bytes((folder / "moving.nii.gz").read_bytes()[:2000])
        for row, (key, value) in zip(rows[-3:], BROKEN.items(), strict=True):
            row[key] = value
    pd.DataFrame(rows).fillna("").to_csv(folder / "subjects.csv", index=False)
    path = folder / "cohort.yaml"
    YAML(typ="safe").dump({"config": "run.yaml", "subjects": "subjects.csv", "cluster": {"workers": workers}}, path)
    return path


def kill_workers(out: Path, times: int, killed: list[int]) -> None:
    """Kill the process that holds the lock of a run which has drawn something, so many times."""
    while len(killed) < times:
        time.sleep(1.0)
        for state in out.glob("*/draws"):
            if RunFolder(state.parent).stage != "prepared" or len(list(state.glob("*.npz"))) < 2:
                continue
            holders = _holders(state.parent / ".lock")
            if holders and holders[0] not in killed:
                os.kill(holders[0], signal.SIGKILL)
                killed.append(holders[0])
                break


def _holders(lock: Path) -> list[int]:
    """Processes that have a file open."""
    found = []
    for process in Path("/proc").iterdir():
        if process.name.isdecimal():
            try:
                if any(os.readlink(one) == str(lock.absolute()) for one in (process / "fd").iterdir()):
                    found.append(int(process.name))
            except OSError:
                continue
    return found


def main() -> int:
    """As above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--subjects", type=int, default=24)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--external", action="store_true")
    given = parser.parse_args()
    cohort, out = write_cohort(given.out, given.subjects, workers=3, steps=given.steps), given.out.absolute() / "runs"
    programs: list[subprocess.Popen] = []
    address = None
    if given.external:
        address = "tcp://127.0.0.1:8791"
        programs.append(subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "8791",
                                          "--host", "127.0.0.1", "--no-dashboard"]))  # fmt: skip
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--nworkers", "3",
                  "--memory-limit", "0", "--no-dashboard"]  # fmt: skip
        programs.append(subprocess.Popen(worker))
    killed: list[int] = []
    killer = threading.Thread(target=kill_workers, args=(out, 2, killed), daemon=True)
    killer.start()
    try:
        table = batch(cohort, out, address)
        ended = {path: digest_of(path) for path in out.glob("*/posterior.nc")}
        again = batch(cohort, out, address, progress=False)
    finally:
        for program in programs:
            program.terminate()
    untouched = all(digest_of(path) == digest for path, digest in ended.items())
    states = table["state"].value_counts().to_dict()
    print(table[["folder", "state", "message"]].to_string())
    untouched = untouched and again["state"].equals(table["state"])
    print(f"killed {len(killed)} workers; {states}; nothing run twice: {untouched}")
    shutil.rmtree(given.out / "alone", ignore_errors=True)
    with quick_reports():
        br.run(br.load_config(given.out / "run.yaml", ["seed=1"]), given.out / "alone", progress=False)
    same = contents(given.out / "alone" / "posterior.nc") == contents(out / "s01" / "posterior.nc")
    print(f"s01 is as if it had been run alone: {same}")
    right = states == {"finished": given.subjects - 3, "failed": 3} and untouched and same and len(killed) == 2
    return int(not right)


if __name__ == "__main__":
    sys.exit(main())
