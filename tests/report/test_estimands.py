import numpy as np
import pytest
import xarray as xr

from bayesreg.report.estimands import Diagnosed, above, draws_of, estimands, parameter_groups, worst
from tests.phantoms import ball_mesh

MESH = ball_mesh(40.0, 30.0)
NODES = np.array([5, 2, 9])


def make(lam_shape: int = 3) -> tuple[xr.Dataset, Diagnosed]:
    rng = np.random.default_rng(0)
    tissue = {1: ["uniform"], 3: list(MESH.names)}.get(lam_shape, range(lam_shape))
    posterior = xr.Dataset(
        {
            "u_boundary": (("chain", "draw", "node", "axis"), rng.normal(size=(2, 40, 3, 3))),
            "lam": (("chain", "draw", "tissue"), rng.gamma(5, size=(2, 40, lam_shape))),
            "mu": (("chain", "draw", "tissue"), np.ones((2, 40, lam_shape))),
            "t_similarity": (("chain", "draw"), rng.gamma(5, size=(2, 40))),
        },
        coords={"node": NODES, "axis": list("xyz"), "tissue": list(tissue)},
    )
    posterior["ratio"] = posterior["lam"] / posterior["mu"]
    figures = posterior.isel(chain=0, draw=0, drop=True)
    figures["mu"] = figures["mu"] * np.nan
    return posterior, Diagnosed(1 + abs(figures), 100 + figures, 200 + figures)


def test_every_sampled_entry_has_its_name_place_and_figures():
    posterior, diagnosed = make()
    entries = estimands(MESH, diagnosed, posterior)
    assert len(entries) == 9 + 3 + 1
    names = {entry.name: entry for entry in entries}
    displacement = names["u_z of node 2"]
    assert displacement.place == pytest.approx(tuple(MESH.points[2]))
    assert displacement.rhat == pytest.approx(float(diagnosed.rhat["u_boundary"].sel(node=2, axis="z")))
    assert displacement.ess_tail == pytest.approx(float(diagnosed.ess_tail["u_boundary"].sel(node=2, axis="z")))
    np.testing.assert_array_equal(draws_of(posterior, displacement, 100), posterior["u_boundary"].sel(node=2, axis="z"))
    assert draws_of(posterior, names["λ wm"], 10).shape == (2, 10)
    assert names["λ wm"].place is None
    assert "T_s" in names


def test_a_fixed_entry_is_none_but_one_stuck_at_different_places_is_the_worst():
    posterior, diagnosed = make()
    posterior["mu"][1, :, 2] = 2.0
    entries = estimands(MESH, diagnosed, posterior)
    assert [entry.name for entry in entries if entry.variable == "mu"] == ["μ wm"]
    assert worst(entries, 1)[0].name == "μ wm"
    assert above(entries, 1e9) == 1


def test_a_displacement_that_never_moved_is_the_worst():
    posterior, diagnosed = make()
    posterior["u_boundary"][:, :, 1, 2] = 0.3
    for dataset in diagnosed:
        dataset["u_boundary"][1, 2] = np.nan
    entries = estimands(MESH, diagnosed, posterior)
    assert len(entries) == 9 + 3 + 1
    assert worst(entries, 1)[0].name == "u_z of node 2"


def test_elements_are_named_with_their_centre():
    posterior, diagnosed = make(len(MESH.cells))
    names = {entry.name: entry for entry in estimands(MESH, diagnosed, posterior)}
    assert names["λ of element 4"].place == pytest.approx(tuple(MESH.points[MESH.cells[4]].mean(axis=0)))


def test_groups_by_tissue_uniform_and_by_element():
    posterior, _ = make()
    groups = parameter_groups(MESH, posterior)
    assert [group.name for group in groups] == list(MESH.names)
    np.testing.assert_array_equal(groups[1].ratio[..., 0], posterior["lam"].isel(tissue=1))
    assert [group.name for group in parameter_groups(MESH, make(1)[0])] == ["uniform"]
    posterior, _ = make(len(MESH.cells))
    gathered = parameter_groups(MESH, posterior, max_draws=20)
    np.testing.assert_array_equal(gathered[2].lam, posterior["lam"].to_numpy()[:, ::2, MESH.tissue == 2])


def test_a_ratio_without_denominator_is_undefined_not_infinite():
    posterior, _ = make()
    posterior["mu"][:] = 0.0
    assert np.isnan(parameter_groups(MESH, posterior)[0].ratio).all()
