"""Run a cohort of small subjects, some of them broken, and kill two of its worker processes.

    python -m studies.endurance.cohort -o DIR [--subjects 24] [--external]

Three of 24 subjects are broken, and three workers run them all. The program expects 21 right results and three named
failures, and that no finished subject is run twice. Otherwise it ends with status 1. With --external it starts a Dask
scheduler and its workers first.
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
    """Write a cohort whose last three subjects are broken, each in its own way; return the path of cohort.yaml."""
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
    """Kill `times` processes, each while it holds the lock of a run that has stored draws."""
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
    """Return the ids of the processes that have a file open."""
    process_ids = []
    for process in Path("/proc").iterdir():
        if process.name.isdecimal():
            try:
                if any(os.readlink(descriptor) == str(lock.absolute()) for descriptor in (process / "fd").iterdir()):
                    process_ids.append(int(process.name))
            except OSError:
                continue
    return process_ids


def main() -> int:
    """Run the cohort and print what became of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--subjects", type=int, default=24)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--external", action="store_true")
    arguments = parser.parse_args()
    cohort, out = (
        write_cohort(arguments.out, arguments.subjects, workers=3, steps=arguments.steps),
        arguments.out.absolute() / "runs",
    )
    programs: list[subprocess.Popen] = []
    address = None
    if arguments.external:
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
        digests = {path: digest_of(path) for path in out.glob("*/posterior.nc")}
        second_table = batch(cohort, out, address, progress=False)
    finally:
        for program in programs:
            program.terminate()
    untouched = all(digest_of(path) == digest for path, digest in digests.items())
    states = table["state"].value_counts().to_dict()
    print(table[["folder", "state", "message"]].to_string())
    untouched = untouched and second_table["state"].equals(table["state"])
    print(f"killed {len(killed)} workers; {states}; nothing run twice: {untouched}")
    shutil.rmtree(arguments.out / "alone", ignore_errors=True)
    with quick_reports():
        br.run(br.load_config(arguments.out / "run.yaml", ["seed=1"]), arguments.out / "alone", progress=False)
    same_as_alone = contents(arguments.out / "alone" / "posterior.nc") == contents(out / "s01" / "posterior.nc")
    print(f"s01 equals a run of s01 alone: {same_as_alone}")
    as_expected = (
        states == {"finished": arguments.subjects - 3, "failed": 3} and untouched and same_as_alone and len(killed) == 2
    )
    return int(not as_expected)


if __name__ == "__main__":
    sys.exit(main())
