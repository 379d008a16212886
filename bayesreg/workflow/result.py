"""A finished run: to open it, to write its report anew, and to put several side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from bayesreg.inference.draws.diagnostics import Convergence, convergence
from bayesreg.inference.draws.inference_data import open_posterior
from bayesreg.io import store
from bayesreg.io.ledger import locked, require_file, require_unchanged, writing
from bayesreg.io.records import Run
from bayesreg.mesh import TetMesh
from bayesreg.pose import Motion
from bayesreg.types import InputError

POSTERIOR, REPORT = "posterior.nc", "report.html"


@dataclass(frozen=True, eq=False)
class Result:
    """A finished run.

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
        """The draws, as ArviZ opens them."""
        return open_posterior(require_file(self.folder, POSTERIOR))

    @cached_property
    def convergence(self) -> Convergence:
        """R̂ and effective sample sizes of every estimand."""
        return convergence(self.idata)

    @property
    def mesh(self) -> TetMesh:
        """The mesh of the registration."""
        return self.run.mesh

    @property
    def u_mean(self) -> np.ndarray:
        """Posterior mean displacement of every node, (n, 3), mm."""
        return np.asarray(self.run.u_mean)

    @property
    def u_sd(self) -> np.ndarray:
        """Posterior standard deviation of the displacement of every node, (n, 3), mm."""
        return np.asarray(self.run.u_sd)

    @property
    def pose(self) -> Motion | None:
        """The rigid part of the displacement, the pose that was found first included, of some draws of every chain.

        Translation of the mesh's centre, mm, and rotation about it, degrees, each (chains, draws, 3); None for runs of
        versions that did not keep it.
        """
        if self.run.predicted is None:
            return None
        return Motion(*np.split(np.asarray(self.run.predicted.motion), 2, axis=-1))

    @property
    def metrics(self) -> dict[str, Any] | None:
        """The paper's Tables 1 and 2 and the coverage of intervals, where the truth is known."""
        return self.run.metrics

    @property
    def converged(self) -> bool | None:
        """Whether the stop rule held and the report's rank-normalised R̂ agrees; None where no rule was set."""
        return self.run.manifest["stopped"]["converged"]

    @property
    def report(self) -> Path:
        """The HTML report."""
        return self.folder / REPORT


def load_result(folder: str | Path) -> Result:
    """Open a finished run; InputError where the folder holds none, or a file of it is damaged."""
    run = store.read_run(folder)
    require_file(folder, POSTERIOR)
    require_unchanged(folder, but=REPORT)
    return Result(Path(folder), run)


def report(folder: str | Path) -> Path:
    """Write the report of a finished run anew, and return its path."""
    from bayesreg.report.html import write_report

    # A folder that is none of a run is not locked, and so not made.
    store.require_finished(folder)
    with locked(folder):
        result = load_result(folder)
        with writing(folder) as place:
            write_report(result.run, result.idata, *result.convergence, place(REPORT))
    return result.report


def compare(folders: Sequence[str | Path], out: str | Path) -> Path:
    """Put runs side by side on one page, and return its path."""
    from bayesreg.report.compare import write_comparison

    if not Path(out).absolute().parent.is_dir():
        raise InputError(f"{out} cannot be written: there is no folder {Path(out).parent}")
    results = [load_result(folder) for folder in folders]
    write_comparison([(r.run, r.idata, *r.convergence) for r in results], out)
    return Path(out)
