"""Draws of the displacement of every node of a run, and the transform that they make."""

from __future__ import annotations

import numpy as np
import xarray as xr
from jaxtyping import Float

from bayesreg.config import model_of
from bayesreg.fem.deformation import Deformer
from bayesreg.inference.draws.inference_data import dataset
from bayesreg.inference.draws.predictive import evenly_spaced, push_forward, thin
from bayesreg.io.records import Inputs, Run
from bayesreg.model.blocks import Blocks
from bayesreg.model.coordinates import fill
from bayesreg.model.elastic.boltzmann import Boltzmann
from bayesreg.model.options import ModelConfig
from bayesreg.model.problem import body_of
from bayesreg.model.state import Body, state_of
from bayesreg.results.result import Result
from bayesreg.results.transform import Transform
from bayesreg.types import AnyArray

# Draws of all chains together.
POINT_DRAWS = 1000


def transform_of(result: Result, draws: int = POINT_DRAWS) -> Transform:
    """The transform of a run from the fixed image's world to the moving one's, with up to so many of its draws."""
    run = result.run
    # The files that the configuration names need not be there any more.
    u = nodal_draws(model_of(run.config), run, dataset(result.idata, "posterior"), draws)
    return Transform(Deformer(run.mesh), run.matching.pose, run.u_mean, u, seed=int(run.manifest["seed"]))


def nodal_draws(
    model: ModelConfig, inputs: Inputs | Run, draws: xr.Dataset, most: int
) -> Float[np.ndarray, "draws nodes 3"]:
    """The displacement of every node, mm, of up to so many evenly spaced draws of a run, of all chains in turn.

    Nodes that are not sampled follow from those that are, and from λ and μ.
    """
    if not most:
        return np.empty((0, *inputs.mesh.points.shape))
    chains = draws.sizes["chain"]
    some = thin(draws, [str(name) for name in draws.data_vars if name != "ratio"], chains * -(-most // chains))
    # As few of each chain as there may be are still too many where the number is no multiple of theirs.
    count = some["u_boundary"].shape[1]
    draw, chain = np.divmod(evenly_spaced(chains * count, most), chains)
    some = {name: values[chain, draw][None] for name, values in some.items()}
    u = some["u_boundary"]
    if u.shape[2] == len(inputs.mesh.points):
        return u[0]
    body, blocks = body_of(inputs.mesh, with_known_boundary(model, inputs))
    known = {name: values for name, values in some.items() if name in blocks}

    def displacement(draw: dict[str, AnyArray], given: tuple[Body, Blocks]) -> AnyArray:
        body, blocks = given
        return state_of(body, blocks, fill(blocks, draw)).u

    every = np.concatenate(list(push_forward(displacement, known, (body, blocks))), axis=1)
    return every.reshape(-1, *every.shape[2:])


def with_known_boundary(model: ModelConfig, inputs: Inputs | Run) -> ModelConfig:
    """The model of a run, whose boundary nodes are held if their displacement is known."""
    if inputs.boundary is None:
        return model
    held = dict(zip(inputs.mesh.boundary.tolist(), map(tuple, np.asarray(inputs.boundary).tolist()), strict=True))
    return model.model_copy(update={"elastic_prior": Boltzmann(nodes=[], held=held)})
