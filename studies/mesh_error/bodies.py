"""Bodies of known stiffness, moved on a finer mesh and registered on the one in question."""

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

# How far the μ of a body may lie from that of the run, as a factor, and its push, as a share of the run's.
FACTOR, PUSH = 1.5, (0.85, 1.15)
# Directions that are tried for one body: along some a tetrahedron inverts, or the skull is in the way.
ATTEMPTS = 30
# Share of the nodes on the boundary that are pushed.
PATCH_SHARE = 0.045


class Subject(NamedTuple):
    """The part of a problem that all bodies of a mesh share.

    Attributes
    ----------
    fixed, tissue, skull : Image
        As `make_pair` takes them.
    making, registering : TetMesh
        A finer mesh, and the one in question.
    model : ModelConfig
        Of the registration.
    image_options : mapping
        How the pair of images is compared (`bayesreg.ImagePair`).
    lam, mu : mapping
        Tissue name to the value of a fluid, or to one about which those of a solid tissue lie.
    displacement, noise_sd, smoothing_mm : float
        How far a patch moves, mm; the noise on each image; the width of a smoothing of `fixed` beforehand.
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
        Tissue to λ/μ, of the body and at the mode of its posterior on the registering mesh; of tissues whose λ/μ the
        registration has to find; a fluid is none of them.
    failed : str
        Why the registration cannot be counted; empty if it can.
    """

    seed: int
    true: dict[str, float]
    found: dict[str, float]
    failed: str = ""


def sought_tissues(model: ModelConfig, names: tuple[str, ...]) -> list[str]:
    """Solid tissues of which λ or μ is free."""
    known = [model.known(names).get(parameter) for parameter in ("lam", "mu")]
    return [name for name in names if not is_fluid(name) and not all(of_tissue(model, given, name) for given in known)]


def register_body(subject: Subject, seed: int) -> Body:
    """A body of random λ/μ, pushed somewhere, and what its registration finds.

    Without a skull: where a body slides along it, it may hold nodes of the registering mesh that lie a little outside.
    """
    rng = np.random.default_rng(seed)
    names, model = subject.registering.names, subject.model
    lam, mu, known = dict(subject.lam), dict(subject.mu), model.known(names)
    low, high = np.log(RANGE)
    for name in names:
        ratio, factor = float(np.exp(rng.uniform(low, high))), FACTOR ** float(rng.uniform(-1, 1))
        lam_known, mu_known = (of_tissue(model, known.get(parameter), name) for parameter in ("lam", "mu"))
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
    found = {name: float(ratios[names.index(name)]) for name in tissues}
    if inverted:
        return Body(seed, true, found, f"the search for the mode turned tetrahedra inside out ({inverted})")
    if not all(0 < ratio < np.inf for ratio in found.values()):
        return Body(seed, true, {}, "the search has no end")
    return Body(seed, true, found)


def _push(
    subject: Subject,
    rng: np.random.Generator,
    lam: Float[np.ndarray, "tissues"],
    mu: Float[np.ndarray, "tissues"],
) -> SyntheticPair:
    """A pair with a patch of its own in the upper half, where a brain is free."""
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
    """Values at the mode, and how many tetrahedra it turns inside out."""
    rest = np.asarray(ravel_pytree(posterior.unconstrain(posterior.reference()))[0])
    values = posterior.constrain(unravel(posterior.target)(jnp.asarray(find_mode(posterior.target, rest))))
    mesh, u = posterior.mesh, np.asarray(posterior.evaluate(values).u)
    return values, int((signed_volumes(mesh.points + u, mesh.cells) <= 0).sum())
