"""Bodies of known stiffness, deformed on a finer mesh and registered on the mesh under test."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from bayesreg.image import Image
from bayesreg.inference.gaussian.mode_search import find_mode
from bayesreg.inference.layout import unravel
from bayesreg.mesh import TetMesh, signed_volumes
from bayesreg.model.build import build_posterior
from bayesreg.model.observations.images.pair import ImagePair
from bayesreg.model.options import ModelConfig, of_tissue
from bayesreg.model.posterior import Posterior
from bayesreg.synthetic.pair import SyntheticPair, make_pair
from bayesreg.tissues import is_fluid
from bayesreg.types import InputError
from studies.mesh_error.recalibration import RANGE

# The greatest ratio of a body's μ to the run's; the range of a body's displacement as a share of the run's.
FACTOR, PUSH = 1.5, (0.85, 1.15)
# The number of directions that are tried for one body: some invert a tetrahedron, or the skull is in the way.
ATTEMPTS = 30
# Share of the nodes on the boundary that are pushed.
PATCH_SHARE = 0.045


class Subject(NamedTuple):
    """The part of a problem that all bodies of a mesh share.

    Attributes
    ----------
    fixed, tissue, skull : Image
        The images that `make_pair` takes.
    making, registering : TetMesh
        The finer mesh that makes the bodies, and the mesh under test.
    model : ModelConfig
        The model of the registration.
    image_options : mapping
        How the pair of images is compared (`bayesreg.ImagePair`).
    lam, mu : mapping
        The value of each fluid, and the centre of the values of each solid tissue, by tissue name.
    displacement, noise_sd, smoothing_mm : float
        The displacement of a patch, mm; the noise on each image; the width of the smoothing of `fixed`.
    """

    fixed: Image
    tissue: Image
    skull: Image
    making: TetMesh
    registering: TetMesh
    model: ModelConfig
    image_options: Mapping[str, Any]
    lam: Mapping[str, float]
    mu: Mapping[str, float]
    displacement: float
    noise_sd: float
    smoothing_mm: float = 0.75


class Body(NamedTuple):
    """One simulated registration.

    Attributes
    ----------
    seed : int
    true, found : dict
        λ/μ by tissue: of the body, and at the mode of its posterior on the registering mesh. They hold the solid
        tissues whose λ/μ is unknown.
    failed : str
        The reason why the registration failed; empty if it succeeded.
    """

    seed: int
    true: dict[str, float]
    found: dict[str, float]
    failed: str = ""


def sought_tissues(model: ModelConfig, names: tuple[str, ...]) -> list[str]:
    """Solid tissues of which λ or μ is free."""
    known_parameters = [model.known(names).get(parameter) for parameter in ("lam", "mu")]
    return [
        name
        for name in names
        if not is_fluid(name) and not all(of_tissue(model, values, name) for values in known_parameters)
    ]


def register_body(subject: Subject, seed: int) -> Body:
    """Push a body of random λ/μ in a random direction, and register it.

    The registration has no skull: where the body slides along the skull, nodes of the registering mesh may lie a little
    outside.
    """
    rng = np.random.default_rng(seed)
    names, model = subject.registering.names, subject.model
    lam, mu, known_parameters = dict(subject.lam), dict(subject.mu), model.known(names)
    low, high = np.log(RANGE)
    for name in names:
        ratio, factor = float(np.exp(rng.uniform(low, high))), FACTOR ** float(rng.uniform(-1, 1))
        lam_known, mu_known = (of_tissue(model, known_parameters.get(parameter), name) for parameter in ("lam", "mu"))
        if not is_fluid(name):
            mu[name] = mu_known or (lam_known / ratio if lam_known else mu[name] * factor)
            lam[name] = lam_known or ratio * mu[name]
    tissues = sought_tissues(model, names)
    true = {name: lam[name] / mu[name] for name in tissues}
    try:
        pair = _push(subject, rng, *(np.array([values[name] for name in names]) for values in (lam, mu)))
        images = ImagePair(pair.fixed, pair.moving, **subject.image_options)
        values, inverted = _mode(build_posterior(subject.registering, [images], model))
    except InputError as error:
        return Body(seed, true, {}, str(error))
    ratios = np.asarray(values["lam"]) / np.asarray(values["mu"])
    estimated = {name: float(ratios[names.index(name)]) for name in tissues}
    if inverted:
        return Body(seed, true, estimated, f"the search for the mode turned tetrahedra inside out ({inverted})")
    if not all(0 < ratio < np.inf for ratio in estimated.values()):
        return Body(seed, true, {}, "the search has no end")
    return Body(seed, true, estimated)


def _push(
    subject: Subject,
    rng: np.random.Generator,
    lam: Float[np.ndarray, "tissues"],
    mu: Float[np.ndarray, "tissues"],
) -> SyntheticPair:
    """Make a pair whose patch lies in the upper half, where a brain can move."""
    patch_nodes = max(round(PATCH_SHARE * len(subject.making.boundary)), 3)
    for _ in range(ATTEMPTS):
        direction = rng.normal(size=3)
        direction[2] = abs(direction[2]) + 0.2 * np.linalg.norm(direction)
        try:
            return make_pair(
                *subject[:4],
                lam=lam,
                mu=mu,
                displacement=subject.displacement * rng.uniform(*PUSH),
                patch_nodes=patch_nodes,
                direction=tuple(direction.tolist()),
                smoothing_mm=subject.smoothing_mm,
                noise_sd=subject.noise_sd,
                seed=int(rng.integers(2**31)),
            )
        except InputError as error:
            last = error
    raise InputError(f"no patch can be pushed by {subject.displacement:.1f} mm; the last attempt: {last}") from last


def _mode(posterior: Posterior) -> tuple[dict[str, Any], int]:
    """Return the values at the mode, and the number of tetrahedra that it turns inside out."""
    rest = np.asarray(ravel_pytree(posterior.unconstrain(posterior.reference()))[0])
    values = posterior.constrain(unravel(posterior.target)(jnp.asarray(find_mode(posterior.target, rest))))
    mesh, u = posterior.mesh, np.asarray(posterior.evaluate(values).u)
    return values, int((signed_volumes(mesh.points + u, mesh.cells) <= 0).sum())
