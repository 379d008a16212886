"""Places of either image that say nothing: masks on grids of their own."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import bayesreg as br
from bayesreg.image import Image
from bayesreg.model.observations.images.likelihood import ImageLikelihood
from bayesreg.model.state import state_of
from bayesreg.types import InputError
from tests.model.test_gradients import assert_gradient
from tests.options import image_options_of, model_of
from tests.phantoms import box_mesh

MESH = box_mesh(3, size=30.0)
AFFINE = np.diag([1.5, 1.5, 1.5, 1.0])
RNG = np.random.default_rng(0)
FIXED, MOVING = (Image(RNG.normal(size=(21, 21, 21)), AFFINE) for _ in range(2))
# mm: what is ignored lies below it, on a grid of its own.
END = 12.0
IGNORE = Image(np.arange(60)[:, None, None] * np.ones((60, 60, 60)) < 20, np.diag([0.6, 0.6, 0.6, 1.0]))
MODEL = model_of(sampled="all", fixed={"lam": 1.0, "mu": 1.0})


def build(similarity="ssd", t_similarity=4.0, interpolation="linear", **ignored):
    options = image_options_of(similarity=similarity, t_similarity=t_similarity, interpolation=interpolation)
    return br.build_posterior(MESH, [br.ImagePair(FIXED, MOVING, **ignored, **options)], MODEL)


def test_no_point_is_compared_where_the_fixed_image_is_ignored():
    term, whole_term = (build(**options).data.terms["images"] for options in ({"fixed_ignore": IGNORE}, {}))
    x = np.asarray(whole_term.positions)[:, 0]
    # The image's voxels lie at multiples of 1.5 mm. The one at the end is ignored as the neighbour of an ignored one,
    # and so is half the way to the next.
    np.testing.assert_allclose(term.positions, np.asarray(whole_term.positions)[x > END + 0.75])
    assert (x <= END + 0.75).any()


@pytest.mark.parametrize(("similarity", "t_similarity"), [("ssd", 4.0), ("student_t", {"median": 4.0})])
def test_the_density_is_that_of_noise_where_one_looks_and_of_any_intensity_elsewhere(similarity, t_similarity):
    """By SciPy's densities, point by point."""
    post, displacement = build(similarity, t_similarity, moving_ignore=IGNORE), RNG.normal(size=MESH.points.shape)
    term, values = post.data.terms["images"], {**post.reference(), "u_boundary": displacement}
    places = term.places(displacement)
    f, m, w = np.asarray(term.fixed_values), np.asarray(term.moving(places)), np.asarray(term.quadrature.weights)
    x = np.asarray(places)[:, 0]
    share = np.clip((x - END) / 1.5, 0, 1)
    assert ((share > 0) & (share < 1)).any()
    scale = np.sqrt(float(values["t_similarity"]) / (2 * w))
    kind = stats.norm if similarity == "ssd" else partial(stats.t, 4.0)
    hidden = kind(loc=f.mean(), scale=np.sqrt(scale**2 + f.var()))
    expected = share * kind(scale=scale).logpdf(f - m) + (1 - share) * hidden.logpdf(f)
    assert float(post.energies(values)["images"]) == pytest.approx(expected.sum(), rel=1e-9)


@pytest.mark.parametrize("similarity", ["ssd", "student_t"])
def test_replicates_are_drawn_from_the_density(similarity):
    """By SciPy's distributions: m and noise where one looks, any intensity of f and noise where one does not."""
    post, count = build(similarity, moving_ignore=IGNORE), 400
    displacement = np.random.default_rng(3).normal(size=MESH.points.shape)
    values = post.fill({**post.reference(), "u_boundary": displacement})
    state, term = state_of(post.data.body, post.data.blocks, values), post.data.terms["images"]
    replicates = np.asarray(term.likelihood(state).sample(jax.random.key(0), (count,)))
    places = term.places(displacement)
    f, m, w = (np.asarray(x) for x in (term.fixed_values, term.moving(places), term.quadrature.weights))
    noise, variance = stats.norm() if similarity == "ssd" else stats.t(4.0), 4.0 / (2 * w)
    x = np.asarray(places)[:, 0]
    hidden, visible = x < END, x > END + 1.5
    assert min(hidden.sum(), visible.sum()) > 50
    for points, mean, scale in (
        (visible, m, np.sqrt(variance)),
        (hidden, np.full_like(f, f.mean()), np.sqrt(variance + f.var())),
    ):
        z = ((replicates - mean) / scale)[:, points]
        assert stats.kstest(z.ravel(), noise.cdf).pvalue > 1e-3
        of_points = z.mean(axis=0) * np.sqrt(count) / noise.std()
        assert abs(of_points).max() < 5
        assert (of_points**2).mean() == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("similarity", ["ssd", "student_t", "lncc"])
def test_the_gradient_is_that_of_differences(similarity):
    post = build(similarity, interpolation="cubic", moving_ignore=IGNORE)
    position = {
        name: value + 0.3 * np.random.default_rng(2).normal(size=np.shape(value))
        for name, value in post.initial(jax.random.key(0)).items()
    }
    assert_gradient(post.logdensity, position)


@pytest.mark.parametrize("similarity", ["ssd", "student_t", "lncc", "mi", "mind"])
@pytest.mark.parametrize("smoothing", [0.0, 0.8])
def test_intensities_that_are_ignored_change_nothing(similarity, smoothing):
    """Nor beside the mask, where smoothing, interpolation and descriptors would reach into it."""
    options = {"similarity": similarity, "smoothing": smoothing, "interpolation": "cubic"}
    voxels, fixed = np.array(MOVING.voxels), np.array(FIXED.voxels)
    voxels[:8], fixed[:8] = 1000.0, -500.0
    pairs = (FIXED, MOVING), (FIXED.with_voxels(fixed), MOVING.with_voxels(voxels))
    original, altered = (
        br.build_posterior(MESH, [br.ImagePair(*pair, fixed_ignore=IGNORE, moving_ignore=IGNORE, **options)], MODEL)
        for pair in pairs
    )
    values = {**original.reference(), "u_boundary": RNG.normal(scale=0.1, size=MESH.points.shape)}
    for name in ("images", "elastic"):
        assert float(altered.energies(values)[name]) == pytest.approx(float(original.energies(values)[name]), rel=1e-12)


def test_beyond_its_own_grid_a_mask_ignores_nothing():
    """A mask that was cropped to what it holds is worth as much as on the whole grid."""
    mask_voxels = np.zeros((60, 60, 60))
    mask_voxels[20:30, 22:34, 18:28] = 1
    cropped = Image(mask_voxels[20:30, 22:34, 18:28], IGNORE.affine.copy())
    cropped.affine[:3, 3] = IGNORE.affine[:3, :3] @ (20, 22, 18)
    for which in ("fixed_ignore", "moving_ignore"):
        whole_term, cropped_term = (
            build(**{which: mask}).data.terms["images"] for mask in (IGNORE.with_voxels(mask_voxels), cropped)
        )
        np.testing.assert_array_equal(whole_term.positions, cropped_term.positions)
        if which == "moving_ignore":
            shares = [np.asarray(term.visible(term.positions)) for term in (whole_term, cropped_term)]
            np.testing.assert_array_equal(*shares)
            assert 0.5 < shares[0].mean() < 1


def test_no_warmth_of_the_similarity_draws_points_into_the_mask():
    """The warmer the less a point that fits differs from a hidden one, but it is never the less probable."""
    for t_similarity in (1e-3, 1.0, 1e3):
        post = build("student_t", t_similarity, moving_ignore=IGNORE)
        term = post.data.terms["images"]
        same = term._replace(fixed_values=term.moving(term.positions))
        visible = same._replace(visible=lambda places: jnp.ones(len(places)))
        hidden = same._replace(visible=lambda places: jnp.zeros(len(places)))
        values = post.reference()
        logs = [float(_log(variant, values)) for variant in (visible, hidden)]
        assert logs[0] > logs[1]


def _log(term, values):
    compared = term.compared(term.positions, values)
    return ImageLikelihood(term, compared, values["t_similarity"]).log_prob(term.fixed_values)


def test_curvature_is_nothing_where_one_does_not_look():
    term = build(moving_ignore=IGNORE).data.terms["images"]
    u = jnp.zeros(MESH.points.shape)
    matrices = np.abs(np.asarray(term.gauss_newton(u, {"t_similarity": jnp.asarray(1.0)}).matrices)).max(axis=(1, 2))
    x = np.asarray(term.positions)[:, 0]
    assert (matrices[x < END] == 0).all()
    assert (matrices[x > END + 1.5] > 0).all()


def test_a_mask_of_everything_is_refused():
    with pytest.raises(InputError, match="nothing is left to compare"):
        build(fixed_ignore=IGNORE.with_voxels(np.ones(IGNORE.shape)))


def test_a_mask_that_is_no_image_is_refused():
    with pytest.raises((InputError, TypeError), match="moving_ignore"):
        br.ImagePair(FIXED, MOVING, moving_ignore=np.ones((3, 3, 3)))
