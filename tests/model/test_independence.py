"""Effective number of independent points, on fields whose correlation is known."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import scipy.sparse
from scipy import ndimage

import bayesreg as br
from bayesreg.image import Image
from bayesreg.inference.chains.beginning import first_checkpoint, temper_target
from bayesreg.inference.gaussian.mode_search import approach
from bayesreg.inference.layout import flat_position
from bayesreg.model.coordinates import complete
from bayesreg.model.observations.images.independence import (
    excess_of_patches,
    independent_blocks,
    independent_points,
    independent_scores,
)
from bayesreg.model.term import PointCurvature, SharedCurvature
from bayesreg.types import InputError
from tests.options import posterior_of
from tests.phantoms import ball_mesh, rotated_affine, smooth_image

SIZES = np.array([1.0, 1.5, 2.0])
SHAPE = (60, 44, 36)


def ball():
    """A mask that is no box."""
    axes = (np.arange(n) - (n - 1) / 2 for n in SHAPE)
    return sum((x / (n / 2)) ** 2 for x, n in zip(np.meshgrid(*axes, indexing="ij"), SHAPE, strict=True)) < 1


def affine():
    corners = np.array([[0.0, 0.0, 0.0], (np.array(SHAPE) - 1) * SIZES])
    rotation = rotated_affine(corners, SHAPE)[:3, :3]
    matrix = np.eye(4)
    matrix[:3, :3] = rotation / np.linalg.norm(rotation, axis=0) * SIZES
    return matrix


def field(width, seed=0):
    """White noise smoothed by a Gaussian of sd `width` mm: ρ(h) = exp(−h² / 4 width²)."""
    noise = np.random.default_rng(seed).normal(size=SHAPE)
    return 0.3 + 2 * ndimage.gaussian_filter(noise, width / SIZES, mode="wrap", truncate=6)


def curvature_of(slopes, groups):
    """The curvature of unit noise whose mean in each group is integrated out."""
    size = np.bincount(groups)[groups]
    shared = SharedCurvature(groups, (slopes / np.sqrt(size)[:, None])[None], -np.ones(1))
    nothing = np.zeros((len(slopes), 4))
    return PointCurvature(nothing.astype(int), nothing, slopes[:, :, None] * slopes[:, None], shared)


@pytest.mark.parametrize(("repeats", "expected"), [(1, 1.0), (4, 0.25)])
def test_blocks_count_how_often_noise_repeats(repeats, expected):
    """Noise that is equal at `repeats` neighbours, where slopes are equal, too, counts once for all of them."""
    rng, groups = np.random.default_rng(0), np.arange(64_000) // 64
    slopes = np.repeat(rng.normal(size=(64_000 // repeats, 3)), repeats, axis=0)
    noise = np.repeat(rng.normal(size=64_000 // repeats), repeats)
    noise -= (np.bincount(groups, weights=noise) / 64)[groups]
    share = independent_blocks(noise[:, None] * slopes, curvature_of(slopes, groups), groups // 4)
    assert share == pytest.approx(expected, rel=0.1)


def test_blocks_ignore_forces_that_cancel_within_them():
    """The product of noise and its own gradient is a gradient, whose sum over a block is small."""
    rng, groups = np.random.default_rng(0), np.arange(64_000) // 64
    slopes = rng.normal(size=(64_000, 3))
    noise = rng.normal(size=64_000)
    noise -= (np.bincount(groups, weights=noise) / 64)[groups]
    forces = noise[:, None] * slopes
    own = rng.normal(size=(32_000, 1))
    cancelling = 5 * np.stack([own, -own], axis=1).reshape(-1, 1) * np.ones(3)
    assert (cancelling**2).sum() > 10 * (forces**2).sum()
    share = independent_blocks(forces + cancelling, curvature_of(slopes, groups), groups // 4)
    assert share == pytest.approx(1, rel=0.1)


def test_no_force_is_an_error():
    slopes = np.ones((8, 3))
    with pytest.raises(InputError, match="residual is zero"):
        independent_blocks(0 * slopes, curvature_of(slopes, np.zeros(8, int)), np.zeros(8, int))


@pytest.mark.parametrize("width", [1.6, 2.5])
def test_smooth_noise_has_the_volume_of_its_correlation(width):
    """∫ρ = (4π width²)^(3/2)."""
    mask = ball()
    volume = mask.sum() * SIZES.prod()
    expected = volume / (4 * np.pi * width**2) ** 1.5
    grid = affine()
    counts = [
        independent_points(Image(field(width, seed), grid), Image(mask.astype(np.uint8), grid)) for seed in range(6)
    ]
    assert np.mean(counts) == pytest.approx(expected, rel=0.1)
    assert 0.6 * expected < min(counts) < max(counts) < 1.5 * expected


def test_white_noise_is_worth_all_its_points():
    grid, mask = affine(), ball()
    noise = np.random.default_rng(1).normal(size=SHAPE)
    count = independent_points(Image(noise, grid), Image(mask.astype(np.uint8), grid))
    assert 0.9 * mask.sum() < count <= mask.sum()


def test_outside_the_mask_nothing_matters():
    grid, mask = affine(), ball()
    values = field(2.0)
    changed = np.where(mask, values, 1e3)
    first, second = (independent_points(Image(v, grid), Image(mask.astype(np.uint8), grid)) for v in (values, changed))
    assert first == pytest.approx(second, rel=1e-12)


def test_what_has_no_autocorrelation():
    grid = affine()
    image, mask = Image(np.ones(SHAPE), grid), Image(ball().astype(np.uint8), grid)
    with pytest.raises(ValueError, match="constant inside the mask"):
        independent_points(image, mask)
    with pytest.raises(ValueError, match="one grid"):
        independent_points(Image(np.ones((3, 3, 3)), grid), mask)


def test_scores_of_white_noise_are_worth_all_their_points():
    grid, voxels = Image(np.zeros(SHAPE), affine()), np.argwhere(ball())
    scores = np.random.default_rng(1).normal(size=(len(voxels), 3))
    assert 0.9 * len(voxels) < independent_scores(scores, voxels, grid) <= len(voxels)


@pytest.mark.parametrize("density", [1.0, 0.2])
def test_scores_of_some_voxels_count_by_the_variance_of_their_sum(density):
    """n independent ones of the same variance would have a sum as variable as this one, over many realisations."""
    rng = np.random.default_rng(0)
    chosen = np.argwhere(ball() & (rng.uniform(size=SHAPE) < density))
    indices, counts, sums, variance = tuple(chosen.T), [], [], []
    for seed in range(60):
        values = field(2.0, seed)[indices] - 0.3
        sums.append(values.sum())
        variance.append((values**2).mean())
        if seed < 6:
            counts.append(independent_scores(values[:, None], chosen, Image(np.zeros(SHAPE), affine())))
    expected = len(chosen) ** 2 * np.mean(variance) / np.mean(np.square(sums))
    assert np.mean(counts) == pytest.approx(expected, rel=0.4)
    assert np.mean(counts) < 0.5 * len(chosen)


def test_a_residual_of_nothing_is_told():
    with pytest.raises(InputError, match="zero at every point"):
        independent_scores(np.zeros((3, 1)), np.arange(9).reshape(3, 3), Image(np.zeros(SHAPE), affine()))


MESH = ball_mesh(spacing=30.0)
OPTIONS = {
    "body_load": 0.3,
    "surface_load": 0.3,
    "priors": {"lam": {"high": 60.0}, "mu": {"high": 60.0}},
    "quadrature": "voxels",
    "interpolation": "cubic",
    "t_similarity": 0.5,
}


def posterior(**options):
    images = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    return posterior_of(*images, MESH, **(OPTIONS | options))


def test_scores_are_what_the_images_pull_with():
    """Their sum, against differences of the energy where all nodes are shifted."""
    post = posterior(similarity="student_t")
    values = post.fill(post.reference())
    term, shift = post.images, np.array([0.3, -0.2, 0.5])
    scores = np.asarray(term.scores(values["u_boundary"], values))
    assert scores.shape == (len(term.positions), 3)
    ahead, behind = (post.evaluate({**values, "u_boundary": values["u_boundary"] + h * shift}) for h in (1e-4, -1e-4))
    slope = float(ahead.similarity_energy - behind.similarity_energy) / 2e-4
    assert -scores.sum(axis=0) @ shift == pytest.approx(slope, rel=1e-6)


@pytest.mark.long
def test_residuals_temper_the_likelihood_where_that_is_wanted(caplog):
    caplog.set_level(logging.INFO)
    post = posterior(independent_points="residual")
    assert not post.tempered
    tempered = temper_target(post.target, 2, 0).posterior
    count = tempered.independent_points["images"]
    assert tempered.tempered
    assert caplog.messages
    # The images are smooth, and no displacement makes them equal: far fewer than all are independent.
    assert 1 < count < 0.2 * len(post.images.positions)
    values = complete(post.data.blocks, tempered.search_start)
    assert post.count_independent_points(values)["images"] == pytest.approx(count, rel=1e-9)
    same = posterior(independent_points=count)
    assert float(tempered.logdensity_constrained(values)) == pytest.approx(float(same.logdensity_constrained(values)))
    assert temper_target(tempered.target, 2, 0) is tempered.target


@pytest.mark.long
def test_a_search_goes_on_where_the_tempering_has_led_to():
    tempered = temper_target(posterior(independent_points="residual").target, 2, 0)
    start, search_start = (
        np.asarray(flat_position(tempered, tempered.data, values))
        for values in (tempered.coordinates.reference(), tempered.mode_search.search_start)
    )
    np.testing.assert_array_equal(approach(tempered, start), search_start)


@pytest.mark.parametrize("misfit", [0.0, 0.7])
def test_forces_on_patches_tell_noise_from_a_misfit_as_wide_as_a_tetrahedron(misfit):
    """A linear model in closed form: the mode of y = ∇m · u + noise under a Normal prior; the noise has sd one."""
    mesh, rng = ball_mesh(spacing=16.0), np.random.default_rng(0)
    cells, count = rng.integers(len(mesh.cells), size=20_000), 3 * len(mesh.points)
    weights, slopes = rng.dirichlet(np.ones(4), len(cells)), rng.normal(size=(len(cells), 3))
    rows = np.repeat(np.arange(len(cells)), 12)
    columns = (3 * mesh.cells[cells][:, :, None] + np.arange(3)).ravel()
    J = scipy.sparse.csr_array(((weights[:, :, None] * slopes[:, None]).ravel(), (rows, columns)), (len(cells), count))
    H = (J.T @ J).toarray() + 4 * np.eye(count)
    points = PointCurvature(mesh.cells[cells], weights, slopes[:, :, None] * slopes[:, None])
    excess = []
    for _ in range(12):
        shift = misfit * rng.normal(size=(len(mesh.cells), 3)) / np.sqrt(len(cells) / len(mesh.cells))
        y = J @ (rng.normal(size=count) / 2) + (shift[cells] * slopes).sum(axis=1) + rng.normal(size=len(cells))
        residual = y - J @ np.linalg.solve(H, J.T @ y)
        excess.append(excess_of_patches(residual[:, None] * slopes, points, H))
    if misfit:
        assert np.mean(excess) > 1.2
    else:
        assert np.mean(excess) == pytest.approx(1, abs=0.05)


def test_residuals_tell_of_voxels_alone():
    images = (smooth_image(MESH.points, seed=seed) for seed in (1, 2))
    with pytest.raises(ValueError, match="residual needs quadrature: voxels"):
        br.build_posterior(MESH, [br.ImagePair(*images, independent_points="residual", quadrature="gauss4")])


@pytest.mark.long
def test_draws_are_resumed_with_the_posterior_that_they_are_of():
    post = posterior(independent_points="residual")
    checkpoint = first_checkpoint(post.with_independent_points({"images": 20.0}).target, "hmc", 2, 0, warm_up=2)
    with pytest.raises(InputError, match="resume them with the posterior of their samples"):
        br.sample(post, "hmc", 2, 4, resume=(checkpoint, []), warm_up=2, progress=False)
