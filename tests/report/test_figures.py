import base64
import io
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest
from matplotlib.figure import Figure

from bayesreg.report import adequacy, anatomy, convergence, marginals, style
from bayesreg.report.estimands import Diagnosed, estimands, parameter_groups
from bayesreg.report.panels import View, from_zero, symmetric
from bayesreg.tissues import colours_of
from tests.report.conftest import make_study


@pytest.fixture(scope="module")
def view(study):
    return View.of(study.run)


@pytest.fixture(scope="module")
def by_element():
    """Two chains of two draws, one stiffness per element, no convergence figures."""
    study = make_study(draws=2, chains=2, spacing=24.0, shape=(20, 22, 18))
    posterior = study.idata.posterior.drop_dims("tissue")
    lam = np.random.default_rng(0).gamma(3, size=(2, 2, len(study.run.mesh.cells)))
    for name, values in (("lam", lam), ("mu", 2 * np.ones_like(lam))):
        posterior[name] = (("chain", "draw", "tissue"), values)
    return study.run, posterior, study.idata.sample_stats


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    monkeypatch.setattr(style, "DPI", 40)


def pixels(drawing) -> np.ndarray:
    picture = PIL.Image.open(io.BytesIO(base64.b64decode(drawing.uri.split(",")[1])))
    return np.asarray(picture.convert("RGB")) / 255


def test_the_error_on_a_plane_is_the_norm_of_the_interpolated_error(study, view):
    plane, run = view.main, study.run
    picture = view.error(plane)
    inside = view.slice(plane).inside
    difference = view.slice(plane).nodal(run.u_mean) - view.slice(plane).nodal(run.truth.u)
    np.testing.assert_allclose(picture[inside], np.sqrt((difference[inside] ** 2).sum(axis=-1)), atol=1e-12)
    assert np.isnan(picture[~inside]).all()


def test_an_error_without_truth_is_refused(clinical_study):
    view = View.of(clinical_study.run)
    with pytest.raises(ValueError, match="only where the truth is"):
        view.error(view.main)


def test_the_residual_is_that_of_the_labelled_voxels(study):
    run = study.run
    inside = np.asarray(run.tissue.voxels) > 0
    expected = np.sqrt(np.mean((np.asarray(run.moving.voxels) - np.asarray(run.fixed.voxels))[inside] ** 2))
    assert anatomy.residual_sd(run, run.moving) == pytest.approx(expected, rel=1e-9)
    assert f"{expected:.3f}" in anatomy.registration(View.of(run)).caption


@pytest.mark.parametrize("draw", [anatomy.registration, adequacy.residual])
def test_plain_differences_are_no_residual_of_unlike_contrasts(study, draw):
    manifest = study.run.manifest
    unlike = replace(study.run, manifest={**manifest, "model": {**manifest["model"], "similarity": "lncc"}})
    said = "maps of f − m(x + ū) do not show its residual"
    assert said in draw(View.of(unlike)).caption
    assert said not in draw(View.of(study.run)).caption


def test_one_colour_range_holds_all_pictures_and_signs_balance():
    assert from_zero(np.array([1.0, np.nan]), np.array([5.0]), quantile=1.0).vmax == 5.0
    norm = symmetric(np.array([-3.0, 1.0, np.nan]), quantile=1.0)
    assert (norm.vmin, norm.vmax) == (-3.0, 3.0)


def test_pictures_differ_where_the_runs_do(study, view):
    mirrored = study.run.u_mean * (-1.0)
    other = View(type(study.run)(**{**vars(study.run), "u_mean": mirrored}), view.planes, view.main)
    assert np.abs(pixels(anatomy.displacement(view)) - pixels(anatomy.displacement(other))).max() > 0.2


def test_stiffness_by_element_is_mapped_by_its_median(by_element):
    run, posterior, _ = by_element
    found = anatomy.element_ratio(run, posterior)
    np.testing.assert_allclose(found, np.median(posterior["lam"].to_numpy() / 2, axis=(0, 1)))
    drawing = anatomy.element_stiffness(View.of(run), posterior)
    assert drawing.key == "elements"
    assert pixels(drawing).std() > 0.02


def test_there_is_no_map_by_element_for_parameters_by_tissue(study, view):
    assert anatomy.element_stiffness(view, study.idata.posterior) is None


def test_two_draws_without_any_convergence_figure_are_drawn_all_the_same(by_element):
    run, posterior, statistics = by_element
    nothing = posterior.isel(chain=0, draw=0, drop=True) * np.nan
    entries = estimands(run.mesh, Diagnosed(nothing, nothing, nothing), posterior)
    drawings = [
        marginals.stiffness(run, posterior),
        marginals.skull_node(run, posterior),
        convergence.traces(posterior, statistics, entries),
        convergence.distributions(run.mesh, entries, posterior["node"].to_numpy(), 1.01),
    ]
    assert [drawing.key for drawing in drawings] == ["stiffness", "node", "traces", "distributions"]
    assert all(len(drawing.uri) > 5000 for drawing in drawings)


def test_the_median_and_interval_stand_above_a_histogram(study):
    axes = Figure().subplots()
    group = parameter_groups(study.run.mesh, study.idata.posterior)[1]
    marginals.ratio_panel(axes, study.run, group)
    low, median, high = np.quantile(group.ratio, (0.025, 0.5, 0.975))
    assert axes.get_title(loc="right") == f"{median:.2f} [{low:.2f}, {high:.1f}]"
    assert "truth" in [text.get_text().strip() for text in axes.texts]


def test_a_truth_far_from_the_draws_is_named_at_the_edge(study):
    draws = np.random.default_rng(0).normal(10.0, 1.0, size=(3, 200))
    axes = Figure().subplots()
    marks = [
        marginals.Mark(-90.0, "a", "black"),
        marginals.Mark(12.0, "b", "black"),
        marginals.Mark(90.0, "c", "black"),
    ]
    marginals.histogram(axes, draws, "grey", marks)
    assert [text.get_text().strip() for text in axes.texts] == ["← a −90.0", "b", "c 90.0 →"]
    low, high = axes.get_xlim()
    assert 5 < low < high < 16


def test_only_ratios_get_a_logarithmic_axis():
    draws = np.random.default_rng(0).lognormal(0.0, 2.0, size=(3, 200))
    scales = []
    for ratio in (True, False):
        axes = Figure().subplots()
        marginals.histogram(axes, draws, "grey", [], ratio=ratio)
        scales.append(axes.get_xscale())
    assert scales == ["log", "linear"]


def test_many_chains_have_many_colours():
    assert len(set(style.chain_colours(16))) == 16
    assert len(set(colours_of(["csf", "gm", "wm", "tumour", "oedema"]))) == 5
    assert colours_of(["WM", "tumour"])[0] == colours_of(["csf", "gm", "wm"])[2]


def test_areas_on_a_logarithmic_axis_are_shares_of_the_draws():
    draws = np.random.default_rng(0).lognormal(1.0, 2.0, size=(3, 4000))
    axes = Figure().subplots()
    marginals.histogram(axes, draws, "grey", [], ratio=True)
    values, edges, _ = axes.patches[0].get_data()
    assert (values * np.diff(np.log(edges))).sum() == pytest.approx(1, abs=0.01)
    # Log-normal draws are Normal to the eye: the peak stands over the median.
    peak = edges[values.argmax() : values.argmax() + 2].mean()
    assert abs(np.log(peak) - 1.0) < 1.0


def test_sampled_scales_are_drawn_with_their_prior(study):
    posterior = study.idata.posterior
    assert marginals.temperatures(study.run, posterior) is None
    chains, draws = posterior.sizes["chain"], posterior.sizes["draw"]
    hot = np.random.default_rng(0).lognormal(np.log(0.05), 0.1, size=(chains, draws))
    fixed = posterior.assign(t_similarity=(("chain", "draw"), np.full((chains, draws), 0.05)))
    assert marginals.temperatures(study.run, fixed) is None
    sampled = posterior.assign(t_similarity=(("chain", "draw"), hot))
    plain = marginals.temperatures(study.run, sampled)
    model = study.run.manifest["model"] | {"t_similarity": {"median": 0.05, "log_sd": 0.3}}
    run = replace(study.run, manifest=study.run.manifest | {"model": model})
    assert np.abs(pixels(marginals.temperatures(run, sampled)) - pixels(plain)).max() > 0.2
    assert "T_s" in plain.alt
    assert "T_r" not in plain.alt
