"""Draws of the displacement of every node of a run, and the transform from these draws."""

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
from bayesreg.model.submesh import Unresolved, unresolved_in
from bayesreg.results.result import Result
from bayesreg.results.transform import Transform
from bayesreg.types import AnyArray

# Default number of draws of all chains together for points.
POINT_DRAWS = 1000


def transform_of(result: Result, draws: int = POINT_DRAWS) -> Transform:
    """Build the transform of a run from the fixed image's world to the moving one's, with at most `draws` draws."""
    run = result.run
    # `model_of` does not open the files that the configuration names, since they may no longer exist.
    model, sampled = model_of(run.config), dataset(result.idata, "posterior")
    u = nodal_draws(model, run, sampled, draws)
    unresolved = unresolved_by(model, run, sampled, u)
    return Transform(Deformer(run.mesh), run.matching.pose, run.u_mean, u, unresolved, seed=int(run.manifest["seed"]))


def unresolved_by(
    model: ModelConfig, inputs: Inputs | Run, draws: xr.Dataset, u: Float[np.ndarray, "draws nodes 3"]
) -> Unresolved:
    """Make the distribution of what the mesh cannot resolve, from draws and the displacements u of some of them, mm."""
    body, blocks = body_of(inputs.mesh, with_known_boundary(model, inputs))
    names = [name for name in blocks if name in draws and name != "u_boundary"]
    values = fill(blocks, {name: draws[name].mean(("chain", "draw")).to_numpy() for name in names})
    return unresolved_in(body, values, u)


def nodal_draws(
    model: ModelConfig, inputs: Inputs | Run, draws: xr.Dataset, most: int
) -> Float[np.ndarray, "draws nodes 3"]:
    """Compute the displacement of every node, mm, for at most `most` evenly spaced draws, from all chains in turn.

    Displacements of nodes that are not sampled are computed from the sampled ones and from λ and μ.
    """
    if not most:
        return np.empty((0, *inputs.mesh.points.shape))
    chains = draws.sizes["chain"]
    thinned = thin(draws, [str(name) for name in draws.data_vars if name != "ratio"], chains * -(-most // chains))
    # Every chain gave the same number of draws, so that there are too many if `most` is no multiple of the chains.
    count = thinned["u_boundary"].shape[1]
    draw, chain = np.divmod(evenly_spaced(chains * count, most), chains)
    selected = {name: values[chain, draw][None] for name, values in thinned.items()}
    u = selected["u_boundary"]
    if u.shape[2] == len(inputs.mesh.points):
        return u[0]
    body, blocks = body_of(inputs.mesh, with_known_boundary(model, inputs))
    estimands = {name: values for name, values in selected.items() if name in blocks}

    def displacement(draw: dict[str, AnyArray], body_and_blocks: tuple[Body, Blocks]) -> AnyArray:
        body, blocks = body_and_blocks
        return state_of(body, blocks, fill(blocks, draw)).u

    displacements = np.concatenate(list(push_forward(displacement, estimands, (body, blocks))), axis=1)
    return displacements.reshape(-1, *displacements.shape[2:])


def with_known_boundary(model: ModelConfig, inputs: Inputs | Run) -> ModelConfig:
    """Return the model of a run; hold the boundary nodes fixed if their displacement is known."""
    if inputs.boundary is None:
        return model
    held = dict(zip(inputs.mesh.boundary.tolist(), map(tuple, np.asarray(inputs.boundary).tolist()), strict=True))
    return model.model_copy(update={"elastic_prior": Boltzmann(nodes=[], held=held)})
