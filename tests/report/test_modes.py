import numpy as np
import xarray as xr

from bayesreg.report import grouping as grouping_module
from bayesreg.report.grouping import group_means, grouping, thin
from bayesreg.report.modes import explanation
from tests.phantoms import box_mesh

MESH = box_mesh(2)
NODES = MESH.boundary


def posterior_of(offsets: list[float], drift: float = 0.0, seed: int = 0) -> xr.Dataset:
    """Independent draws of sd 0.2 about 0; in five nodes along z about an offset for each chain, in mm."""
    rng = np.random.default_rng(seed)
    u = 0.2 * rng.normal(size=(len(offsets), 80, len(NODES), 3))
    u[:, :, 3:8, 2] += np.asarray(offsets)[:, None, None]
    u += drift * np.linspace(-0.5, 0.5, 80)[:, None, None]
    lam = 5 + rng.normal(size=(len(offsets), 80, 3))
    dims = ("chain", "draw", "node", "axis")
    return xr.Dataset({"u_boundary": (dims, u), "lam": (("chain", "draw", "tissue"), lam)}, coords={"node": NODES})


def test_chains_about_one_place_are_one_group():
    chain_groups = grouping(posterior_of([0.0, 0.1, -0.1, 0.0]))
    assert chain_groups.groups == 1
    assert not chain_groups.drifting.any()


def test_chains_apart_are_groups_in_the_order_of_their_first():
    chain_groups = grouping(posterior_of([2.0, 0.0, 2.1, 0.0]))
    np.testing.assert_array_equal(chain_groups.label, [0, 1, 0, 1])
    text = " ".join(explanation(chain_groups))
    assert "group 1: chains 1, 3; group 2: chains 2, 4" in text
    assert "several modes" in text
    np.testing.assert_array_equal(group_means(np.array([1.0, 2.0, 3.0, 4.0]), chain_groups), [2, 3])


def test_one_estimand_alone_does_not_part_chains():
    posterior = posterior_of([0.0, 0.0])
    posterior["lam"][1, :, 0] += 50
    assert grouping(posterior).groups == 1


def test_chains_on_their_way_are_not_called_modes():
    chain_groups = grouping(posterior_of([0.0, 9.0], drift=4.0))
    assert chain_groups.drifting.all()
    assert "have not arrived yet" in " ".join(explanation(chain_groups))
    assert "several modes" not in " ".join(explanation(chain_groups))


def test_chains_that_stand_still_are_apart_only_where_they_differ():
    posterior = posterior_of([0.0, 0.0])
    still = posterior.isel(draw=[0] * 10).isel(chain=[0, 0])
    assert grouping(still).groups == 1
    still["u_boundary"][1] += 1e-6
    assert grouping(still).groups == 2


def test_many_draws_are_thinned_and_grouped_the_same(monkeypatch):
    posterior = posterior_of([2.0, 0.0, 2.1, 0.0])
    monkeypatch.setattr(grouping_module, "MOST_VALUES", posterior["u_boundary"].size // 4)
    np.testing.assert_array_equal(grouping(posterior).label, [0, 1, 0, 1])
    assert thin(posterior).sizes["draw"] == 20
