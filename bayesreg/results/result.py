"""Access to a finished run in its folder."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from bayesreg.inference.draws.diagnostics import Convergence, convergence
from bayesreg.inference.draws.inference_data import open_posterior
from bayesreg.io import store
from bayesreg.io.records import Run
from bayesreg.io.run_folder import RunFolder
from bayesreg.mesh import TetMesh
from bayesreg.pose import Motion

POSTERIOR, REPORT = "posterior.nc", "report.html"


@dataclass(frozen=True, eq=False)
class Result:
    """A finished run with its draws and its convergence.

    Attributes
    ----------
    folder : Path
    run : bayesreg.io.records.Run
        Mesh, images, posterior mean and sd of u at every node, manifest, metrics.
    """

    folder: Path
    run: Run

    @cached_property
    def idata(self) -> Any:
        """The draws as ArviZ's inference data."""
        return open_posterior(RunFolder(self.folder).file(POSTERIOR))

    @cached_property
    def convergence(self) -> Convergence:
        """The R̂ and the effective sample sizes of every estimand."""
        return convergence(self.idata)

    @property
    def mesh(self) -> TetMesh:
        """The mesh of the registration."""
        return self.run.mesh

    @property
    def u_mean(self) -> np.ndarray:
        """The posterior mean displacement of every node, (n, 3), mm."""
        return np.asarray(self.run.u_mean)

    @property
    def u_sd(self) -> np.ndarray:
        """The posterior standard deviation of the displacement of every node, (n, 3), mm."""
        return np.asarray(self.run.u_sd)

    @property
    def pose(self) -> Motion | None:
        """The rigid part of some draws of every chain; it includes the pose that was found before sampling.

        It has the translation of the mesh's centre, mm, and the rotation vector about the centre, degrees, each
        (chains, draws, 3). None for a run of a version that did not store it.
        """
        if self.run.predicted is None:
            return None
        return Motion(*np.split(np.asarray(self.run.predicted.motion), 2, axis=-1))

    @property
    def metrics(self) -> dict[str, Any] | None:
        """The values of the paper's Tables 1 and 2 and the coverage of intervals; None if the truth is unknown."""
        return self.run.metrics

    @property
    def converged(self) -> bool | None:
        """True if the stop rule and the report's rank-normalised R̂ both show convergence; None if no rule was set."""
        return self.run.manifest["stopped"]["converged"]

    @property
    def report(self) -> Path:
        """The path of the HTML report."""
        return self.folder / REPORT


def load_result(folder: str | Path) -> Result:
    """Open a finished run; raise InputError if the folder holds none or a file of it is damaged."""
    run_folder = RunFolder(Path(folder))
    run = store.read_run(run_folder)
    run_folder.file(POSTERIOR)
    run_folder.require_unchanged(but=REPORT)
    return Result(run_folder.path, run)
