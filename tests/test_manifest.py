"""What run.json says beyond what the tests of whole runs look at."""

import numpy as np
import pytest
import xarray as xr

from bayesreg.model.adequacy import describe_observations
from bayesreg.workflow.manifest import inverted_share
from bayesreg.workflow.prediction import mean_values
from tests.options import posterior_of
from tests.phantoms import ball_mesh, box_mesh, smooth_image


def test_noise_of_an_inferred_temperature_is_that_of_its_mean():
    mesh = ball_mesh(spacing=30.0)
    image = smooth_image(mesh.points)
    known, inferred = (posterior_of(image, image, mesh, t_similarity=t) for t in (0.8, {"median": 0.8}))
    dims = ("chain", "draw", "tissue")
    draws = xr.Dataset({name: (dims, np.ones((2, 3, 3))) for name in ("lam", "mu")})
    drawn = draws.assign(t_similarity=(("chain", "draw"), [[3.0, 3.2, 3.4], [2.8, 3.2, 3.6]]))
    rest = np.zeros((len(mesh.points), 3))
    description = describe_observations(known, mean_values(known, draws, rest))["images"]
    assert description["noise_sd"] == known.images.noise_sd(0.8)
    noise_sd = describe_observations(inferred, mean_values(inferred, drawn, rest))["images"]["noise_sd"]
    assert noise_sd == pytest.approx(2 * known.images.noise_sd(0.8))


def test_the_share_of_inverted_tetrahedra_is_over_all_draws():
    mesh = box_mesh()
    u = np.zeros((8, *mesh.points.shape))
    # A reflection turns every tetrahedron of one of eight draws inside out.
    u[5] = mesh.points * [-2.0, 0.0, 0.0]
    assert inverted_share(mesh, u) == pytest.approx(1 / 8)
