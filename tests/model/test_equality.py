"""Posteriors that differ in their images alone are equal, so that what is compiled for one serves the other."""

import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from bayesreg.inference.gaussian.density import _height_and_slope
from bayesreg.inference.gaussian.mode_search import find_mode
from bayesreg.inference.layout import unravel
from tests.options import posterior_of
from tests.phantoms import box_mesh, flat_skull, smooth_image

MESH = box_mesh(2)
SKULL = flat_skull(MESH.points, axis=0, wall=21.0)


def posterior(seed=1, mesh=MESH, skull=SKULL, shape=(14, 11, 16), **options):
    images = (smooth_image(mesh.points, shape, seed=seed + k) for k in range(2))
    return posterior_of(
        *images, mesh, skull, **{"interpolation": "cubic", "rigid_sd": 1.0, "t_similarity": 0.5, **options}
    )


def mode(posterior):
    start = ravel_pytree(posterior.unconstrain(posterior.reference()))[0]
    return find_mode(posterior.target, np.asarray(start))


@pytest.mark.long
def test_what_was_compiled_for_one_finds_the_mode_of_the_other():
    first, second = posterior(seed=1), posterior(seed=3)
    assert first.target == second.target
    assert hash(first.target) == hash(second.target)
    compiled = _height_and_slope._cache_size
    modes = [mode(first)]
    before = compiled()
    modes.append(mode(second))
    assert compiled() == before
    assert abs(modes[0] - modes[1]).max() > 0.1
    # Downhill to the other's mode.
    towards = modes[1] + 0.05 * (modes[0] - modes[1])
    at_mode, beside_mode = (second.logdensity(unravel(second.target)(flat)) for flat in (modes[1], towards))
    assert at_mode > beside_mode


@pytest.mark.parametrize(
    "changed",
    [
        {"skull": None},
        {"mesh": box_mesh(2, seed=1)},
        {"shape": (12, 11, 16)},
        {"t_similarity": 0.6},
        {"fixed": {"mu": {"wm": 1.0}}},
        {"sampled": "all"},
        {"normalised": True, "priors": {"lam": {"high": 9.0}, "mu": {"high": 9.0}}},
    ],
)
def test_what_differs_otherwise_is_not_equal(changed):
    assert posterior().target != posterior(**changed).target
