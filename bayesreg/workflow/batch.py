"""Run many subjects in one command on Dask workers. Each task has one run folder.

Dask is optional; the functions that use it import it.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from bayesreg.config import load_config
from bayesreg.config.cohort import ClusterConfig, Cohort, Task, load_cohort
from bayesreg.inference.chains.progress import NoProgress
from bayesreg.inference.draws.inference_data import dataset
from bayesreg.inference.draws.moments import greatest_rhat
from bayesreg.io.run_folder import STATUS, RunFolder
from bayesreg.messages import from_level
from bayesreg.report.estimands import parameter_groups
from bayesreg.results.result import Result
from bayesreg.types import InputError
from bayesreg.workflow.run import run

TOPIC = "bayesreg"
VISIBLE = "CUDA_VISIBLE_DEVICES"
# The number of workers that may die while they run one subject, before that subject counts as failed.
DEATHS = 5
# The longest wait for the answer of a scheduler.
PATIENCE = "20s"


def batch(
    cohort: str | Path,
    out: str | Path,
    scheduler: str | None = None,
    progress: bool = True,
) -> pd.DataFrame:
    """Run all subjects of a cohort. Finished runs stay as they are; interrupted runs continue.

    Parameters
    ----------
    cohort : path
        The file of the cohort (`bayesreg.config.cohort.CohortConfig`).
    out : path
        A folder that all workers can access. Each run has a subfolder, named after the subject and its settings.
    scheduler : str, optional
        Address of an existing Dask scheduler, such as tcp://host:8786. The default starts workers as the section
        cluster describes.
    progress : bool
        Show the progress of the subjects.

    Returns
    -------
    DataFrame
        One row per run: its state ("finished" or "failed", with a message), convergence, displacement, uncertainty
        and stiffness by tissue. The table is also written as cohort.csv, cohort.parquet and the page cohort.html.

    Raises
    ------
    InputError
        If the cohort's file is wrong, the packages of the extra "batch" are missing, or no scheduler answers.
    """
    from bayesreg.report.cohort import write_cohort

    loaded_cohort, out = load_cohort(cohort), Path(out).absolute()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{out} cannot be a folder: {error.strerror}; name another one") from None
    rows: dict[str, dict[str, Any]] = {}
    # Only workers that run on this machine share its cores.
    shares = loaded_cohort.cluster.workers if scheduler is None and loaded_cohort.cluster.slurm is None else None
    with _client(loaded_cohort.cluster, scheduler) as client, _Board(loaded_cohort, progress) as board:
        client.subscribe_topic(TOPIC, board.show)
        for task, row in _submit(client, loaded_cohort, out, shares):
            rows[task.name] = {"subject": task.subject, **task.settings, "folder": task.name, **row}
            board.end(task, row)
    table = pd.DataFrame([rows[task.name] for task in loaded_cohort.tasks])
    write_cohort(table, out)
    return table


def run_task(config: str, task: Task, folder: str, cores: int | None) -> dict[str, Any]:
    """Run one task in a worker and return its row; only an exception that ends the process is raised."""
    if cores is not None:
        _take_share(cores)
    try:
        settings = load_config(config, task.overrides)
        # Messages of many simultaneous runs do not name their run. The report of each run holds its warnings.
        with from_level(logging.ERROR):
            result = run(settings, folder, resume=True, progress=lambda *budget: _Reporter(task.name, *budget))
        return {"state": "finished", **summarise(result)}
    except InputError as error:
        begun = (Path(folder) / STATUS).exists()
        return {"state": "failed", "message": f"{error} (to begin it anew, remove {folder})" if begun else str(error)}
    except Exception as error:
        # No error of one subject may end the others.
        Path(folder).mkdir(parents=True, exist_ok=True)
        (Path(folder) / "failed.txt").write_text(traceback.format_exc(), encoding="utf-8")
        return {"state": "failed", "message": f"{type(error).__name__}: {error} (see failed.txt in its folder)"}


def summarise(result: Result) -> dict[str, Any]:
    """Make a run's row of the cohort's table: stiffness as median and 95 % interval, displacement and radius in mm."""
    manifest, mesh = result.run.manifest, result.mesh
    share = mesh.nodal_volumes / mesh.nodal_volumes.sum()
    length = np.linalg.norm(result.u_mean, axis=1)
    row = {
        "converged": result.converged,
        "rhat_max": manifest["convergence"]["rhat_max"],
        "ess_min": manifest["convergence"]["ess_bulk_min"],
        "shift_mean_mm": float(share @ length),
        "shift_max_mm": float(length.max()),
        "minutes": manifest["timings"]["total"] / 60,
    }
    if result.run.predicted is not None:
        row["radius95_mean_mm"] = float(share @ np.asarray(result.run.predicted.reach))
    for group in parameter_groups(mesh, dataset(result.idata, "posterior")):
        for name, draws in (("lam", group.lam), ("mu", group.mu)):
            low, median, high = np.quantile(draws, [0.025, 0.5, 0.975])
            row |= {f"{name}_{group.name}{end}": x for end, x in (("", median), ("_low", low), ("_high", high))}
    return row


class _Reporter(NoProgress):
    """Progress of a run that is reported to the Dask scheduler."""

    def __init__(self, name: str, draws: int, max_seconds: float | None, threshold: float | None) -> None:
        self.name, self.draws, self.max_seconds = name, draws, max_seconds

    def show(self, checkpoint: Any, rhat: dict[str, Any]) -> None:
        """Report the greatest R̂, the spent share of the budget and the minutes that are left."""
        from distributed import get_worker

        draws, seconds = int(checkpoint.draws), float(checkpoint.seconds)
        spent = max(draws / self.draws, seconds / self.max_seconds if self.max_seconds else 0.0)
        left = seconds * (1 - spent) / spent / 60 if spent else None
        worst = float(greatest_rhat(rhat["estimands"])) if draws else None
        get_worker().log_event(TOPIC, {"name": self.name, "spent": spent, "rhat": worst, "minutes": left})


def _take_share(count: int) -> None:
    """Restrict the worker to its share of the cores and to one device, before JAX counts them."""
    from distributed import get_worker

    name = get_worker().name
    number = int(name) if str(name).isdecimal() else 0
    os.environ |= share_of_devices(number, count, _devices())
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(_CORES)
        os.sched_setaffinity(0, set(cores[number % count :: count]) or set(cores))


# The cores of the process before `_take_share` restricted it.
_CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()


@cache
def _devices() -> tuple[str, ...]:
    """List the NVIDIA devices that were available before `_take_share`, by their names in CUDA_VISIBLE_DEVICES."""
    visible = os.environ.get(VISIBLE)
    if visible is not None:
        return tuple(name for name in visible.split(",") if name)
    try:
        listed = subprocess.run(["nvidia-smi", "--list-gpus"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return ()
    return tuple(str(index) for index in range(len(listed.splitlines())))


def share_of_devices(number: int, workers: int, devices: Sequence[str]) -> dict[str, str]:
    """Return the environment variables that give a worker one device and a share of the memory of this device."""
    if not devices:
        return {}
    # By default JAX reserves three quarters of the memory of a device.
    beside = -(-workers // len(devices))
    return {VISIBLE: devices[number % len(devices)], "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.75 / beside:.3f}"}


def _submit(client: Any, cohort: Cohort, out: Path, shares: int | None) -> Iterator[tuple[Task, dict[str, Any]]]:
    """Submit all tasks and yield each with its row when it ends; tasks that were begun before are submitted first."""
    from distributed import as_completed

    begun = sorted(cohort.tasks, key=lambda task: _stage_of(out / task.name) != "prepared")
    config, futures = str(cohort.config), {}
    for task in begun:
        future = client.submit(run_task, config, task, str(out / task.name), shares, key=f"run-{task.name}")
        futures[future] = task
    for future in as_completed(futures):
        task = futures.pop(future)
        try:
            row = future.result()
        except Exception as error:
            # Its workers died more than `DEATHS` times, or were not reachable.
            row = {"state": "failed", "message": f"{type(error).__name__}: {error}"}
        # A released result is not computed again if its worker dies.
        future.release()
        yield task, row


def _stage_of(folder: Path) -> str | None:
    """Return the stage of a run; None if there is no run or its status is damaged, which the run itself reports."""
    try:
        return RunFolder(folder).stage
    except (InputError, OSError):
        return None


@contextmanager
def _client(cluster: ClusterConfig, scheduler: str | None) -> Iterator[Any]:
    """Connect to workers: those of an existing scheduler, SLURM jobs, or processes on this machine."""
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise InputError("batches need Dask: pip install 'bayesreg[batch]'") from error
    dask.config.set({"distributed.scheduler.allowed-failures": DEATHS})
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=PATIENCE)
        except (OSError, ValueError) as error:
            raise InputError(f"no Dask scheduler answers at {scheduler}: {error}") from error
        with client:
            yield client
        return
    if cluster.slurm is not None:
        from dask_jobqueue import SLURMCluster

        workers: Any = SLURMCluster(**cluster.slurm)
        workers.scale(cluster.workers)
    else:
        # Dask must not end a worker because of its memory: a restarted run would need as much.
        options = {"threads_per_worker": 1, "memory_limit": None, "dashboard_address": "127.0.0.1:0",
               "silence_logs": logging.CRITICAL}  # fmt: skip
        workers = LocalCluster(n_workers=cluster.workers, **options)
    with workers, Client(workers) as client:
        if cluster.slurm is None:
            client.register_plugin(_deaf_to_interrupts())
        yield client


def _deaf_to_interrupts() -> Any:
    """Make a plugin by which workers ignore Ctrl-C: a terminal sends it to them too, and the parent process acts."""
    from distributed import WorkerPlugin

    class Deaf(WorkerPlugin):
        name = "bayesreg-deaf-to-interrupts"

        def setup(self, worker: Any) -> None:
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGINT, signal.SIG_IGN)

    return Deaf()


class _Board:
    """The progress display of a cohort: the number of runs that ended, and one line for each active run."""

    def __init__(self, cohort: Cohort, shown: bool) -> None:
        self._bar = Progress(
            TextColumn("{task.description}"), BarColumn(bar_width=24), MofNCompleteColumn(),
            TextColumn("{task.fields[figures]}"), TimeElapsedColumn(), disable=not shown,
        )  # fmt: skip
        self._all = self._bar.add_task("runs", total=len(cohort.tasks), figures="")
        self._lines: dict[str, Any] = {}
        self._failed = 0

    def __enter__(self) -> _Board:
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def show(self, event: tuple[float, dict[str, Any]]) -> None:
        """Update the line of a run from its progress report."""
        _, report = event
        if report["name"] not in self._lines:
            self._lines[report["name"]] = self._bar.add_task(report["name"], total=100, figures="")
        rhat = "" if report["rhat"] is None else f"R̂ {report['rhat']:.2f}"
        left = "" if report["minutes"] is None else f"  {report['minutes']:.1f} min to the budget"
        self._bar.update(
            self._lines[report["name"]], completed=round(100 * min(report["spent"], 1)), figures=rhat + left
        )

    def end(self, task: Task, status: dict[str, Any]) -> None:
        """Count a run that ended, and print the message of a failed run."""
        if (line := self._lines.pop(task.name, None)) is not None:
            self._bar.remove_task(line)
        if status["state"] == "failed":
            self._failed += 1
            self._bar.console.print(f"{task.name} failed: {status['message']}", highlight=False, markup=False)
        self._bar.update(self._all, advance=1, figures=f"{self._failed} failed" if self._failed else "")
