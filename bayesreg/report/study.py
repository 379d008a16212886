"""A run in the form that its pages use: the run, its draws, and results that are computed once for all figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from bayesreg.image import Image
from bayesreg.inference.draws.inference_data import dataset
from bayesreg.io.records import Predicted, Run
from bayesreg.mesh import TetMesh
from bayesreg.report.estimands import Diagnosed, Estimand, Group, estimands, parameter_groups
from bayesreg.report.grouping import Grouping, grouping
from bayesreg.report.metrics import compute_metrics
from bayesreg.report.panels import View
from bayesreg.report.slices import sample
from bayesreg.report.verdict import Verdict, nested_entry, verdict
from bayesreg.types import InputError

ELASTICITY = {"tissue": "By tissue", "uniform": "Uniform", "element": "By element", "field": "By tissue, with a field"}
MAX_VOXELS = 200_000


@dataclass(frozen=True, eq=False)
class Study:
    """A run with its draws and its convergence figures.

    Attributes
    ----------
    run : Run
    idata : InferenceData or DataTree
        With the groups `posterior` and `sample_stats`, as in the run folder. The coordinate `node` of u_boundary
        holds mesh node indices.
    rhat, ess_bulk, ess_tail : xarray.Dataset
        The posterior's variables without chain and draw; NaN if an entry was not sampled.
    """

    run: Run
    idata: Any
    rhat: xr.Dataset
    ess_bulk: xr.Dataset
    ess_tail: xr.Dataset

    @property
    def mesh(self) -> TetMesh:
        """The mesh of the run."""
        return self.run.mesh

    @property
    def manifest(self) -> Mapping[str, Any]:
        """The content of run.json."""
        return self.run.manifest

    @property
    def predicted(self) -> Predicted:
        """The predictions of the run; InputError if an old version wrote none."""
        if self.run.predicted is None:
            raise InputError("the run holds no predicted.npz, which its report needs: run it again with this version")
        return self.run.predicted

    @cached_property
    def posterior(self) -> xr.Dataset:
        """The draws of the run."""
        return dataset(self.idata, "posterior")

    @cached_property
    def sample_stats(self) -> xr.Dataset:
        """The statistics of the draws: log density, energies."""
        return dataset(self.idata, "sample_stats")

    @cached_property
    def diagnosed(self) -> Diagnosed:
        """The R̂ and both effective sample sizes of every entry."""
        return Diagnosed(self.rhat, self.ess_bulk, self.ess_tail)

    @cached_property
    def entries(self) -> list[Estimand]:
        """The estimands with their convergence figures."""
        return estimands(self.mesh, self.diagnosed, self.posterior)

    @cached_property
    def parameters(self) -> list[Group]:
        """Draws of λ and μ by tissue."""
        return parameter_groups(self.mesh, self.posterior)

    @cached_property
    def view(self) -> View:
        """The planes on which the run is shown."""
        return View.of(self.run)

    @cached_property
    def groups(self) -> Grouping:
        """The groups of chains that lie together."""
        return grouping(self.posterior)

    @cached_property
    def verdict(self) -> Verdict:
        """Whether the chains converged, and whether they lie apart."""
        judged = verdict(self.manifest, self.entries)
        if self.groups.groups == 1:
            return judged
        sentence = f" The chains lie in {self.groups.groups} groups, each shown under “Chains that disagree”."
        return judged._replace(detail=(judged.detail + sentence).strip())

    @cached_property
    def metrics(self) -> dict[str, Any] | None:
        """The errors against the truth, computed if they were not stored; None if no truth is known."""
        if self.run.metrics is not None or self.run.truth is None:
            return self.run.metrics
        return compute_metrics(self.mesh, self.run.u_mean, self.run.truth, self.posterior)

    @cached_property
    def image_differences(self) -> tuple[float, float] | None:
        """The result of the function `image_differences`."""
        return image_differences(self.run)

    @property
    def is_of_the_paper(self) -> bool:
        """Whether the model is that of the paper."""
        return nested_entry(self.manifest, "model", "preset") == "paper"

    @property
    def samples_nodes(self) -> bool:
        """Whether displacements were sampled; false if the boundary was given (elastography)."""
        return bool(self.posterior.sizes["node"])

    @property
    def elasticity(self) -> str:
        """The variation of the elastic parameters, in words."""
        return ELASTICITY.get(str(nested_entry(self.manifest, "model", "elasticity")), "")

    @property
    def name(self) -> str:
        """The name of the run; without a name, a description of its sampled variables."""
        return str(self.manifest.get("name") or self.elasticity or "Registration")


def image_differences(run: Run) -> tuple[float, float] | None:
    """Compute the root mean square of moving and warped minus fixed image; None unless they have one contrast."""
    if run.fixed is None or run.moving is None or run.warped is None or not run.matching.one_contrast:
        return None
    return rms_difference(run, run.moving), rms_difference(run, run.warped)


def rms_difference(run: Run, image: Image) -> float:
    """Compute the root mean square of an image minus the fixed one over an even sample of the labelled voxels."""
    assert run.fixed is not None
    stride = max(1, int(np.prod(run.fixed.shape) // MAX_VOXELS))
    indices = np.stack(np.unravel_index(np.arange(0, np.prod(run.fixed.shape), stride), run.fixed.shape), axis=-1)
    points = np.asarray(run.fixed.voxel_to_world(indices.astype(float)))
    inside = sample(run.tissue, points, order=0, outside=0.0) > 0
    difference = sample(image, points[inside]) - np.asarray(run.fixed.voxels, float)[tuple(indices[inside].T)]
    return float(np.sqrt(np.nanmean(difference**2)))
