"""The posterior of a registration problem, built from its mesh, its observations and its options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.model.observations.observation import Correlated, Observation, bounding_points
from bayesreg.model.options import ModelConfig
from bayesreg.model.posterior import Posterior
from bayesreg.model.problem import determine_pose, problem_of
from bayesreg.model.state import State, state_of
from bayesreg.model.term import ExternalTerm
from bayesreg.types import AnyArray, InputError


def build_posterior(
    mesh: TetMesh,
    observations: Sequence[Any],
    model: ModelConfig | None = None,
    skull: Image | None = None,
    reference: Mapping[str, AnyArray] | None = None,
) -> Posterior:
    """Build the posterior of a registration problem.

    ``build_posterior(mesh, [ImagePair(fixed, moving), Landmarks(p, q, sd=1.0)])``

    Parameters
    ----------
    mesh : TetMesh
        The mesh of the organ, in the space of the fixed image.
    observations : sequence
        `ImagePair`, `Landmarks`, or any object with a `name` and a function `log(state)` that JAX can trace, the log of
        its factor of the density. The state has the displacements of every node, `state.u` (n, 3), mm, and of points
        inside the mesh, `state.at(points)`.
    model : ModelConfig, optional
        The default is the paper's model.
    skull : Image, optional
        Nonzero voxels, and points off its grid, are forbidden. None: no constraint.
    reference : mapping, optional
        "lam" and "mu" (all entries) where the interior solve is preconditioned and chains start. They are also the
        scales of the coordinates of parameters with a flat prior without an upper bound. Values near the posterior save
        time. Default: the median of a log-normal prior, else `bayesreg.tissues.usual_value`: λ = 10, μ = 1, and 0.01
        for a fluid.

    Returns
    -------
    Posterior

    Raises
    ------
    InputError
        If the mesh does not overlap an image, lies partly in the skull, an option names a tissue or node that
        does not exist, the sampled and held nodes do not hold the mesh, or an observation is wrong.
    """
    if not isinstance(mesh, TetMesh):
        raise InputError(f"build_posterior needs a mesh: a TetMesh; got {type(mesh).__name__}")
    if not isinstance(model, ModelConfig | None):
        raise InputError(f"model must be a ModelConfig, got {type(model).__name__}: give bayesreg.ModelConfig(...)")
    model = model or ModelConfig()
    problem, sampled, prepared = problem_of(mesh, require_observations(observations), model, skull, reference)
    tempered = not any(
        isinstance(observation, Correlated) and observation.is_tempered_by_residuals
        for observation in prepared.values()
    )
    posterior = Posterior(problem, mesh, model, sampled, prepared, tempered=tempered)
    _require_bounded(posterior)
    _require_numbers(posterior)
    return posterior


def require_observations(observations: Any) -> list[Any]:
    """Return the observations as a list; raise InputError if there is none, or one is not an observation."""
    if not isinstance(observations, Sequence):
        raise InputError(
            f"observations must be a list, got {type(observations).__name__}; put one observation in a list, too"
        )
    if not len(observations):
        raise InputError("there is nothing observed: give observations, such as ImagePair(fixed, moving) or Landmarks")
    for observation in observations:
        name = getattr(observation, "name", None)
        is_observation = isinstance(observation, Observation) or callable(getattr(observation, "log", None))
        if not (is_observation and isinstance(name, str) and name):
            raise InputError(
                f"an observation needs a name (text) and a function log(state); got {type(observation).__name__}: use "
                "ImagePair, Landmarks, or an object of your own with both"
            )
        # The name becomes part of variable names in files.
        if not name.isidentifier():
            raise InputError(f"an observation is named {name!r}; expected letters, digits and _, such as left_lobe")
    return list(observations)


def _require_bounded(posterior: Posterior) -> None:
    """Raise InputError if nothing bounds the rigid motions: too few landmarks, no image, no skull and no prior."""
    bounding = [bounding_points(observation) for observation in posterior.observations.values()]
    bounded = not len(posterior.sampled) or {"rigid", "skull"} & set(posterior.data.terms)
    if bounded or any(points is None for points in bounding):
        return
    held = posterior.mesh.points[list(posterior.options.elastic_prior.held)].reshape(-1, 3)
    points = np.concatenate([*(points for points in bounding if points is not None), held])
    if not determine_pose(points):
        raise InputError(
            f"the landmarks and held nodes, {len(points)} in number, do not say how the whole shifts and turns: the "
            "posterior would be improper; give at least three that are not on one line, images, a skull, or "
            "model.rigid_sd"
        )


def _require_numbers(posterior: Posterior) -> None:
    """Raise InputError if an observation from outside the package does not give a real number at rest."""
    problem, values = posterior.data, posterior.reference()
    rest = state_of(problem.body, problem.blocks, values)
    for name, term in problem.terms.items():
        if not isinstance(term, ExternalTerm):
            continue
        log = partial(_log_at, term, rest)
        abstract_value = jax.eval_shape(log, rest.u)
        if getattr(abstract_value, "shape", None) != () or not jnp.issubdtype(abstract_value.dtype, jnp.floating):
            returned = (
                f"shape {abstract_value.shape} of {abstract_value.dtype}"
                if hasattr(abstract_value, "shape")
                else type(abstract_value).__name__
            )
            raise InputError(f"log(state) of the observation {name!r} must give one real number, got {returned}")
        value, slope = jax.value_and_grad(log)(rest.u)
        if jnp.isnan(value) or jnp.isnan(slope).any():
            defect = "is not a number" if jnp.isnan(value) else "has a derivative that is not a number"
            raise InputError(
                f"log(state) of the observation {name!r} {defect} where nothing has moved, and chains may start there; "
                "avoid, for instance, the root of a sum of squares that may be zero"
            )


def _log_at(term: ExternalTerm, state: State, u: AnyArray) -> Any:
    """Compute the log of a term for nodes that are displaced by u, mm."""
    return term.log(replace(state, equilibrium=state.equilibrium._replace(u=u)))
