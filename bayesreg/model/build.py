"""The posterior of a registration problem, built from its mesh, its observations and its options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values
from bayesreg.model.options import ModelConfig
from bayesreg.model.posterior import Posterior
from bayesreg.model.problem import problem_of
from bayesreg.model.program import Problem
from bayesreg.model.state import state_of
from bayesreg.model.terms.images import ImagePair
from bayesreg.model.terms.term import Outside
from bayesreg.types import AnyArray, InputError


def build_posterior(
    fixed: Image | None = None,
    moving: Image | None = None,
    mesh: TetMesh | None = None,
    model: ModelConfig | None = None,
    skull: Image | None = None,
    reference: Mapping[str, AnyArray] | None = None,
    observations: Sequence[Any] | None = None,
) -> Posterior:
    """The posterior of a registration problem.

    ``build_posterior(mesh=mesh, observations=[ImagePair(fixed, moving), Landmarks(p, q, sd=1.0)])``, or, short for one
    pair of images, ``build_posterior(fixed, moving, mesh)``.

    Parameters
    ----------
    fixed, moving : Image, optional
        f and m of one pair of images; their intensities are taken as they are.
    mesh : TetMesh
        In the space of the fixed image.
    model : ModelConfig, optional
        The default is the paper's model.
    skull : Image, optional
        Nonzero = forbidden; off its grid is forbidden too. None: no constraint.
    reference : mapping, optional
        "lam" and "mu" (all entries) where the interior solve is preconditioned and chains start, and the scale of the
        coordinate of a parameter without an upper bound; the nearer to the posterior the faster. Default:
        `bayesreg.tissues.usual_value`: λ = 10, μ = 1, and 0.01 for a fluid.
    observations : sequence, optional
        In place of `fixed` and `moving`: `ImagePair`, `Landmarks`, or any object with a `name` and a function
        `log(state)` that JAX can trace, the log of its factor of the density. It sees the displacement of every node,
        `state.u` (n, 3), mm, and of points inside the mesh, `state.at(points)`.

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
    model, given = model or ModelConfig(), _observations(fixed, moving, observations)
    problem, sampled = problem_of(mesh, given, model, skull, reference)
    posterior = Posterior(problem, mesh, model, sampled, {observation.name: observation for observation in given})
    _require_scalars(posterior)
    return posterior


def _observations(fixed: Image | None, moving: Image | None, observations: Sequence[Any] | None) -> list[Any]:
    """The observations that were given in one of the two forms."""
    if (fixed is None) != (moving is None):
        raise InputError("a pair of images needs both, fixed and moving")
    if fixed is not None and moving is not None and observations is not None:
        raise InputError("give either fixed and moving, or observations; a pair of images is ImagePair(fixed, moving)")
    if fixed is not None and moving is not None:
        return [ImagePair(fixed, moving)]
    if not observations:
        raise InputError("there is nothing observed: give fixed and moving, or observations, such as Landmarks")
    return list(observations)


def _require_scalars(posterior: Posterior) -> None:
    """Raise InputError where an observation from outside gives no real number, before anything long begins."""
    outside = [name for name, term in posterior.data.terms.items() if isinstance(term, Outside)]
    for name in outside:
        found = jax.eval_shape(partial(_log_of, name), posterior.data, posterior.reference())
        if found.shape != () or not jnp.issubdtype(found.dtype, jnp.floating):
            raise InputError(
                f"log(state) of the observation {name!r} must give one real number, got shape {found.shape} of "
                f"{found.dtype}"
            )


def _log_of(name: str, problem: Problem, values: Values) -> Any:
    return jnp.asarray(problem.terms[name].log(state_of(problem.body, problem.blocks, values)))
