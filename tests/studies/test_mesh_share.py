"""The fit of λ/μ to a displacement field: a body on its own mesh gives its own stiffness back."""

import numpy as np
import pytest

from bayesreg.fem.equilibrium import solve_interior
from studies.calibration import pairs
from studies.calibration.mesh_share import fitted
from tests.phantoms import ball_mesh


def test_a_body_on_its_own_mesh_is_recovered():
    mesh = ball_mesh()
    rng = np.random.default_rng(0)
    # A smooth shape change of the boundary: quadratic in place.
    x = mesh.points[mesh.boundary] / np.ptp(mesh.points)
    u = np.einsum("ijk,nj,nk->ni", rng.normal(size=(3, 3, 3)), x, x)
    lam, mu = np.array([0.5, 10.0, 30.0]), np.array([0.2, 1.0, 1.0])
    truth = np.asarray(solve_interior(mesh, lam, mu, u, tolerance=1e-12).u)
    assert fitted(mesh, truth) == pytest.approx((10.0, 30.0), rel=1e-3)
    assert pairs.truth() == pytest.approx({"gm": 10.0, "wm": 30.0})
