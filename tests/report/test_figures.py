import base64
import io
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from bayesreg.distance import signed_distance
from bayesreg.report import anatomy, convergence, marginals, panels, paper, stiffness, style
from bayesreg.report.panels import View, error_of, from_zero, symmetric
from bayesreg.report.slices import sample
from bayesreg.report.study import Study, rms_difference
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
    nothing = posterior.isel(chain=0, draw=0, drop=True) * np.nan
    return Study(study.run, study.idata._replace(posterior=posterior), nothing, nothing, nothing)


def changed(study: Study, **changes) -> Study:
    """The study of another run."""
    return Study(replace(study.run, **changes), study.idata, study.rhat, study.ess_bulk, study.ess_tail)


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    monkeypatch.setattr(style, "DPI", 40)


def pixels(drawing) -> np.ndarray:
    picture = PIL.Image.open(io.BytesIO(base64.b64decode(drawing.uri.split(",")[1])))
    return np.asarray(picture.convert("RGB")) / 255


def test_the_error_on_a_plane_is_the_norm_of_the_interpolated_error(study, view):
    plane, run = view.main, study.run
    picture = view.norm(plane, error_of(run))
    inside = view.slice(plane).inside
    difference = view.slice(plane).nodal(run.u_mean) - view.slice(plane).nodal(run.truth.u)
    np.testing.assert_allclose(picture[inside], np.sqrt((difference[inside] ** 2).sum(axis=-1)), atol=1e-12)
    assert np.isnan(picture[~inside]).all()


def test_an_error_without_truth_is_refused(clinical_study):
    with pytest.raises(ValueError, match="only where the truth is"):
        error_of(clinical_study.run)


def test_the_difference_is_that_of_the_labelled_voxels(seen):
    run = seen.run
    inside = np.asarray(run.tissue.voxels) > 0
    expected = np.sqrt(np.mean((np.asarray(run.moving.voxels) - np.asarray(run.fixed.voxels))[inside] ** 2))
    assert rms_difference(run, run.moving) == pytest.approx(expected, rel=1e-9)
    assert f"{expected:.3f}" in anatomy.before_and_after(seen.run, seen.view, seen.image_differences).caption


def test_the_mesh_is_cut_into_the_tissues_of_its_cells(view):
    """Pixels have the colour of their tetrahedron, and are white outside and between two of them."""
    axes, plane = Figure().subplots(), view.main
    panels.mesh_panel(axes, view.run.mesh, plane)
    picture = np.asarray(axes.images[0].get_array())[1::3, 1::3]
    tissue = view.slice(plane).cellwise(view.run.mesh.tissue)
    rows, columns = (min(a, b) for a, b in zip(picture.shape, tissue.shape, strict=False))
    picture, tissue = picture[:rows, :columns], tissue[:rows, :columns]
    colours = colours_of(view.run.mesh.names)
    for index in np.unique(tissue[np.isfinite(tissue)]).astype(int):
        here = tissue == index
        coloured = (np.abs(picture - to_rgb(colours[index])) < 1e-9).all(axis=-1)
        assert coloured[here].mean() > 0.5
        assert coloured[~here].mean() < 0.03
    assert (picture[np.isnan(tissue)] == 1).mean() > 0.97


def test_the_main_plane_sees_most_of_the_displacement(study):
    points = study.run.mesh.points
    for axis in range(3):
        u = np.exp(-(((points[:, [axis]] - points[300, axis]) / 8) ** 2)) * np.ones(3)
        assert View.of(replace(study.run, u_mean=u, truth=None), points[300]).main.axis == axis


def test_one_colour_range_holds_all_pictures_and_signs_balance():
    assert from_zero(np.array([1.0, np.nan]), np.array([5.0]), quantile=1.0).vmax == 5.0
    norm = symmetric(np.array([-3.0, 1.0, np.nan]), quantile=1.0)
    assert (norm.vmin, norm.vmax) == (-3.0, 3.0)


def _displacement(study):
    return anatomy.displacement(study.run, study.view, study.predicted.reach)


def test_pictures_differ_where_the_runs_do(seen):
    mirrored = changed(seen, u_mean=seen.run.u_mean * (-1.0))
    first_pixels, second_pixels = (pixels(_displacement(study)) for study in (seen, mirrored))
    assert np.abs(first_pixels - second_pixels).max() > 0.2


def test_stiffness_by_element_is_mapped_by_its_median(by_element):
    expected = np.median(by_element.posterior["lam"].to_numpy() / 2, axis=(0, 1))
    np.testing.assert_allclose(stiffness.element_ratio(by_element), expected)
    drawing = stiffness.by_element(by_element)
    assert drawing.key == "elements"
    assert pixels(drawing).std() > 0.02


def test_there_is_no_map_by_element_for_parameters_by_tissue(seen):
    assert stiffness.by_element(seen) is None


def test_two_draws_without_any_convergence_figure_are_drawn_all_the_same(by_element):
    draws = (marginals.marginals, paper.node, convergence.traces)
    drawings = [*(draw(by_element) for draw in draws), convergence.distributions({"": by_element})]
    assert [drawing.key for drawing in drawings] == ["stiffness", "node", "traces", "distributions"]
    assert all(len(drawing.uri) > 5000 for drawing in drawings)


def test_the_node_nearest_to_the_skull_is_shown(seen, clinical_study):
    """By the signed distance of the whole image."""
    nodes = seen.posterior["node"].to_numpy()
    distance = sample(signed_distance(seen.run.skull), (seen.mesh.points + seen.run.u_mean)[nodes])
    away = distance[paper.node_at_skull(seen)]
    assert away <= np.sort(np.abs(distance))[3]
    assert paper.node(Study(*clinical_study)) is None


def test_the_median_and_interval_stand_above_a_histogram(seen):
    axes = Figure().subplots()
    group = seen.parameters[1]
    marginals.ratio_panel(axes, seen.run, group)
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


def test_sampled_scales_are_drawn_with_their_prior(seen):
    chains, draws = seen.posterior.sizes["chain"], seen.posterior.sizes["draw"]
    hot = np.random.default_rng(0).lognormal(np.log(0.05), 0.1, size=(chains, draws))
    posterior = seen.posterior.assign(t_similarity=(("chain", "draw"), hot))
    idata, figures = seen.idata._replace(posterior=posterior), (seen.rhat, seen.ess_bulk, seen.ess_tail)
    scales = {"t_similarity": {"median": 0.05, "log_sd": 0.3}}
    with_prior = replace(seen.run, manifest=seen.manifest | {"scales": scales})
    plain, shown = (marginals.marginals(Study(run, idata, *figures)) for run in (seen.run, with_prior))
    assert plain.title == "Stiffness ratios and scales"
    assert marginals.marginals(seen).title == "Stiffness ratios"
    assert len(base64.b64decode(shown.uri.split(",")[1])) > len(base64.b64decode(plain.uri.split(",")[1]))
