"""The first answer of a run: Laplace's approximation in its folder, while the chains warm up and sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from bayesreg.config import Config
from bayesreg.fem.deformation import Deformer
from bayesreg.io import store
from bayesreg.io.records import Inputs, Run
from bayesreg.io.run_folder import RunFolder
from bayesreg.model import coordinates
from bayesreg.model.posterior import Posterior
from bayesreg.model.submesh import unresolved_in
from bayesreg.results.displacement_fields import moments_on, write_transforms
from bayesreg.results.nodal_draws import POINT_DRAWS, nodal_draws
from bayesreg.results.result import REPORT
from bayesreg.results.transform import Transform, distances_of
from bayesreg.types import AnyArray
from bayesreg.workflow.finish import warp_moving


def write_first_answer(
    config: Config,
    inputs: Inputs,
    posterior: Posterior,
    estimands: Mapping[str, AnyArray],
    appraisal: Mapping[str, Any],
    folder: RunFolder,
) -> None:
    """Write displacement, transforms, warped image and a short report of some independent draws.

    Parameters
    ----------
    config : Config
    inputs : Inputs
    posterior : Posterior
    estimands : mapping
        Draws from Laplace's approximation, as arrays (draw, …).
    appraisal : mapping
        The appraisal of labels and images, with the warnings for the report.
    folder : RunFolder
        The results of the run replace the files later.
    """
    from bayesreg.report.html import write_first_report

    grid, pose = inputs.fixed or inputs.tissue, inputs.matching.pose
    u = nodal_draws(config.model, inputs, _labelled(posterior, estimands), POINT_DRAWS)
    mean = {name: np.mean(draws, axis=0) for name, draws in estimands.items()}
    unresolved = unresolved_in(posterior.data.body, coordinates.complete(posterior.data.blocks, mean), u)
    transform = Transform(Deformer(inputs.mesh), pose, u.mean(axis=0), u, unresolved, seed=config.seed)
    moments = moments_on(transform, grid)
    run = Run(
        manifest={"name": config.description, "appraisal": appraisal},
        u_mean=transform.u_mean,
        u_sd=u.std(axis=0),
        warped=warp_moving(inputs, moments.mean),
        **inputs._asdict(),
    )
    with folder.writing() as place:
        write_transforms(place, replace(transform, draws=transform.draws[:0]), grid)
        store.write_displacement(place, run, *moments.rounded)
        write_first_report(run, distances_of(transform.nodal_covariance()).radius, place(REPORT))


def _labelled(posterior: Posterior, estimands: Mapping[str, AnyArray]) -> xr.Dataset:
    """Name the dimensions of draws, as in the file of a run's draws; the draws are those of one chain."""
    variables = posterior.target.variables
    values = variables.values({name: np.asarray(value)[None] for name, value in estimands.items()})
    labelled = {}
    for name, value in values.items():
        dims = variables.dims.get(name, [f"{name}_dim_{axis}" for axis in range(np.ndim(value) - 2)])
        labelled[name] = (("chain", "draw", *dims), value)
    return xr.Dataset(labelled)
