"""Build the posterior and the start of its chains from a configuration and its inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bayesreg.config import Config
from bayesreg.image import Image
from bayesreg.inference.chains.initialise import Start
from bayesreg.io.demons import find_demons
from bayesreg.io.displacements import read_start
from bayesreg.io.records import Inputs
from bayesreg.mesh import TetMesh
from bayesreg.model.build import build_posterior
from bayesreg.model.options import Lame
from bayesreg.model.posterior import Posterior
from bayesreg.model.problem import cell_entries, lame_parameter
from bayesreg.results.nodal_draws import with_known_boundary
from bayesreg.types import AnyArray, InputError


def posterior_of(
    config: Config,
    inputs: Inputs,
    observations: Sequence[Any] = (),
    independent_points: Mapping[str, float] | None = None,
) -> Posterior:
    """Build the posterior of a run, with observations besides those of its configuration.

    Solves are preconditioned at the start parameters. If the numbers of independent points are given, they temper the
    likelihood.
    """
    model, reference = with_known_boundary(config.model, inputs), _references(config, inputs.mesh)
    observed = [observation for section in config.observations for observation in section.observe(inputs)]
    posterior = build_posterior(inputs.mesh, [*observed, *observations], model, inputs.skull, reference)
    return posterior.with_independent_points(independent_points) if independent_points else posterior


def _references(config: Config, mesh: TetMesh) -> dict[str, AnyArray]:
    return {"lam": _reference("lam", config, mesh), "mu": _reference("mu", config, mesh)}


def _reference(name: Lame, config: Config, mesh: TetMesh) -> Float[np.ndarray, "entries"]:
    """Return all entries of λ or μ at the start: the configuration's values, else those that the model chooses."""
    values = np.array(lame_parameter(name, mesh, config.model, None).reference())
    start_values, entry = config.start.entries(name, mesh.names) or {}, cell_entries(mesh, config.model)
    for index, tissue in enumerate(mesh.names):
        if tissue in start_values:
            values[entry[mesh.tissue == index]] = start_values[tissue]
    return values


def start_of(config: Config, inputs: Inputs, posterior: Posterior) -> Start:
    """Build the start of a configuration's chains."""
    field = _start_field(config, inputs)
    return Start(
        field=None if field is None else field[posterior.sampled],
        fraction=config.start.fraction,
        lam=config.start.entries("lam", posterior.target.variables.entry_names),
        mu=config.start.entries("mu", posterior.target.variables.entry_names),
        spread=config.start.spread,
    )


def _start_field(config: Config, inputs: Inputs) -> np.ndarray | None:
    """Return the displacement of every node at fraction one, mm; None for the identity."""
    wanted = config.start.field
    if wanted == "identity":
        return None
    if wanted == "truth":
        assert inputs.truth is not None
        return np.asarray(inputs.truth.u)
    if wanted == "demons":
        assert inputs.fixed is not None
        assert inputs.moving is not None
        if not inputs.matching.one_contrast:
            raise InputError("start.field: demons compares intensities, and the images are of unlike contrast")
        return _demons(inputs.fixed, inputs.moving, inputs.mesh)
    return read_start(Path(wanted), inputs.mesh, inputs.matching.pose)


@lru_cache(maxsize=1)
def _demons(fixed: Image, moving: Image, mesh: TetMesh) -> np.ndarray:
    """Compute the displacement field of the Demons registration at the nodes, mm."""
    return np.stack([component.interpolate(mesh.points) for component in find_demons(fixed, moving)], axis=-1)


def with_initial(inputs: Inputs, config: Config) -> Inputs:
    """Add the mean start of the chains to the truth, for the paper's Table 1."""
    field = _start_field(config, inputs)
    if inputs.truth is None or field is None:
        return inputs
    return inputs._replace(truth=inputs.truth._replace(initial=np.mean(config.start.fraction) * field))
