"""Places that the images do not support: what is not compared, and what does not fit."""

import numpy as np
import pytest
from scipy import ndimage

import bayesreg as br
from bayesreg.image import Image
from bayesreg.model.observations.images.unsupported import (
    BEYOND,
    NOT_COMPARED,
    STEP,
    SUPPORTED,
    Points,
    explain_unsupported,
    find_unsupported,
    mark_places,
    support_at,
)
from bayesreg.model.state import state_of
from tests.options import model_of
from tests.phantoms import ball_mesh


@pytest.fixture
def ball():
    """Points of a ball of 40 mm, with residuals of Student's t."""
    rng = np.random.default_rng(0)
    positions = rng.uniform(-40, 40, (60_000, 3))
    positions = positions[np.linalg.norm(positions, axis=1) < 40]
    volume = 4 / 3 * np.pi * 40**3 / len(positions)
    residual = rng.standard_t(4, len(positions))
    return Points(positions, residual, np.ones(len(positions)), np.full(len(positions), volume))


def test_noise_marks_nothing(ball):
    support = find_unsupported(ball)
    assert explain_unsupported(support) == []
    assert (support_at(support, ball.positions) == SUPPORTED).mean() > 0.98
    assert support_at(support, np.array([[0.0, 0.0, 70.0]])) == BEYOND


@pytest.mark.parametrize("sign", [1, -1])
def test_a_cavity_is_found_with_its_place_and_volume(ball, sign):
    centre = np.array([10.0, -15.0, 5.0])
    gone = np.linalg.norm(ball.positions - centre, axis=1) < 10
    points = ball._replace(residual=ball.residual + 5 * sign * gone)
    support = find_unsupported(points)
    assert len(support["regions"]) == 2
    volume, *place, mean = support["regions"][1]
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.25)
    assert np.linalg.norm(place - centre) < STEP / 2
    assert mean * sign > 2
    marked = support_at(support, points.positions) == NOT_COMPARED + 1
    assert (marked & gone).sum() > 0.8 * gone.sum()
    [sentence] = explain_unsupported(support)
    assert "--moving-ignore maps/misfit.nii.gz" in sentence
    assert f"{volume:.2g} ml about ({place[0]:.0f}, −15, {place[2]:.0f}) mm" in sentence


def test_outliers_that_are_scattered_mark_nothing(ball):
    rng = np.random.default_rng(1)
    residual = np.where(rng.uniform(size=len(ball.residual)) < 0.05, 100.0, ball.residual)
    assert explain_unsupported(find_unsupported(ball._replace(residual=residual))) == []


def test_what_is_ignored_is_told(ball):
    share = (ball.positions[:, 2] < 20).astype(float)
    support = find_unsupported(ball._replace(share=share, residual=ball.residual * share))
    assert support["unseen"] == pytest.approx(5 / 32, rel=0.02)
    [sentence] = explain_unsupported(support, "t2")
    assert sentence.startswith("16% of the organ, most of it about (")
    assert "of 't2'" in sentence
    assert support_at(support, np.array([[0.0, 0.0, 30.0]])) == NOT_COMPARED


def test_the_mask_of_a_region_is_whole():
    """A tenth of the voxels of a ball is enough to fill it."""
    grid = Image(np.zeros((40, 40, 40)), np.diag([1.0, 1.0, 1.0, 1.0]))
    voxels = grid.grid_points().reshape(-1, 3)
    ball = np.linalg.norm(voxels - 20, axis=1) < 9
    sample = np.random.default_rng(0).uniform(size=len(voxels)) < 0.1
    marked = np.asarray(mark_places(voxels[ball & sample], grid).voxels).ravel() > 0
    assert (marked & ball).sum() > 0.95 * ball.sum()
    assert marked.sum() < 1.35 * ball.sum()


def test_a_pair_finds_what_is_gone_and_what_is_ignored():
    """A dark hole in the moving image, and a slab that the mask of the fixed one ignores."""
    mesh = ball_mesh(spacing=20.0)
    middle, radius = mesh.points.mean(axis=0), np.ptp(mesh.points[:, 0]) / 2
    low = mesh.points.min(axis=0) - 8
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = low
    shape = np.ceil((mesh.points.max(axis=0) + 8 - low) / 2).astype(int)
    rng = np.random.default_rng(0)
    texture = ndimage.gaussian_filter(rng.normal(size=shape), 2)
    fixed = Image(1 + 0.2 * texture / texture.std(), affine)
    away = fixed.grid_points() - middle
    gone = np.linalg.norm(away - [radius / 3, 0, 0], axis=-1) < radius / 3
    moving = fixed.with_voxels(np.where(gone, 0.0, fixed.voxels) + 0.02 * rng.normal(size=shape))
    ignored = fixed.with_voxels((away[..., 2] > 0.6 * radius).astype(np.uint8))
    pair = br.ImagePair(fixed, moving, fixed_ignore=ignored)
    posterior = br.build_posterior(mesh, [pair], model_of(preset="registration"))
    values = posterior.fill(posterior.reference()) | {"t_similarity": np.array(2 * 8 * 0.15**2)}
    [observation] = posterior.observations.values()
    state = state_of(posterior.data.body, posterior.data.blocks, values)
    summary = observation.summarise(posterior, state, {})
    unseen, misfit = observation.doubts(summary)
    assert "is ignored or lies beyond the moving image" in unseen
    assert "maps/misfit.nii.gz" in misfit
    assert len(summary["regions"]) == 2
    maps = observation.maps(summary)
    marked = np.asarray(maps.of_moving["maps/misfit.nii.gz"].voxels) > 0
    assert (marked & gone).sum() > 0.9 * gone.sum()
    assert marked.sum() < 1.6 * gone.sum()
    support = maps.of_fixed["maps/support.nii.gz"]
    assert set(np.unique(support.voxels)) == {BEYOND, SUPPORTED, NOT_COMPARED, NOT_COMPARED + 1}
