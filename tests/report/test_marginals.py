import numpy as np
import pytest

from bayesreg.distance import signed_distance
from bayesreg.report.marginals import REACH, node_at_skull, skull_distance
from bayesreg.report.slices import sample


def test_local_distances_equal_those_of_the_whole_skull(study):
    run = study.run
    rng = np.random.default_rng(0)
    whole = signed_distance(run.skull)
    for node in run.mesh.boundary[:40]:
        points = run.mesh.points[node] + rng.normal(size=(20, 3))
        expected = np.clip(sample(whole, points), -REACH, REACH)
        np.testing.assert_allclose(skull_distance(run.skull, points), expected, atol=1e-9)


def test_points_deep_in_the_skull_or_off_its_grid_are_cut_off(study):
    far = np.array([[1e4, 0.0, 0.0], [1e4, 1.0, 0.0]])
    np.testing.assert_array_equal(skull_distance(study.run.skull, far), -REACH)


def test_the_node_whose_draws_touch_the_skull_is_chosen(study):
    run, posterior = study.run, study.idata.posterior.copy(deep=True)
    nodes = posterior["node"].to_numpy()
    whole = signed_distance(run.skull)
    draws = posterior["u_boundary"]
    # All nodes well inside, one led along the way to the skull until it touches.
    draws[:] = -8 * (run.mesh.points[nodes] - run.mesh.points.mean(axis=0)) / 60
    chosen = 31
    out = run.mesh.points[nodes[chosen]] - run.mesh.points.mean(axis=0)
    steps = np.linspace(-10, 20, 3001)[:, None] * out / np.linalg.norm(out)
    touching = steps[np.abs(sample(whole, run.mesh.points[nodes[chosen]] + steps)).argmin()]
    draws[:, ::2, chosen] = touching
    found = node_at_skull(run, posterior)
    assert (found.entry, found.node) == (chosen, nodes[chosen])
    assert found.near == pytest.approx(0.5, abs=0.2)


def test_without_a_skull_the_node_that_moves_most_is_shown(clinical_study):
    found = node_at_skull(clinical_study.run, clinical_study.idata.posterior)
    u = np.linalg.norm(clinical_study.run.u_mean[clinical_study.run.mesh.boundary], axis=1)
    assert found.entry == u.argmax()
