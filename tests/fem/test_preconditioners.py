"""Solves of many columns against a sparse factor, whichever way they are done."""

import numpy as np
import pytest
import scipy.sparse.linalg

import bayesreg as br
from bayesreg.fem import preconditioners
from bayesreg.fem.elasticity import stiffness, unknowns_of
from bayesreg.fem.preconditioners import solve
from tests.phantoms import box_mesh

MESH = box_mesh(4)


def interior(stretch: float):
    """K_II, cells of stiffnesses that are log-normal with this standard deviation."""
    factor = np.exp(stretch * np.random.default_rng(0).standard_normal(len(MESH.cells)))
    free = unknowns_of(np.setdiff1d(np.arange(len(MESH.points)), MESH.boundary))
    return stiffness(MESH, 10 * factor, factor)[free][:, free]


@pytest.mark.parametrize(("stretch", "limit"), [(0.0, 6000), (3.0, 6000), (3.0, 10), (60.0, 6000)])
def test_columns_are_those_of_a_sparse_factor(stretch, limit, monkeypatch):
    monkeypatch.setattr(preconditioners, "DENSE_LIMIT", limit)
    matrix = interior(stretch)
    right = np.random.default_rng(1).standard_normal((matrix.shape[0], 7))
    expected = scipy.sparse.linalg.splu(matrix.tocsc()).solve(right)
    np.testing.assert_allclose(solve(matrix, right), expected, rtol=1e-8 if stretch < 10 else 1e-3)


@pytest.mark.parametrize("broken", ["empty", "nan"])
@pytest.mark.parametrize("limit", [6000, 1])
def test_what_has_no_solution_is_said(broken, limit, monkeypatch):
    monkeypatch.setattr(preconditioners, "DENSE_LIMIT", limit)
    matrix = interior(0.0).tolil()
    matrix[4] = matrix[:, 4] = 0.0 if broken == "empty" else np.nan
    with pytest.raises(br.InputError, match="the interior stiffness is singular"):
        solve(matrix.tocsr(), np.ones((matrix.shape[0], 1)))
