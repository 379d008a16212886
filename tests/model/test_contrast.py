"""Pairs of unlike contrast, compared through a map of intensities."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

import bayesreg as br
from bayesreg.image import Image
from bayesreg.inference.gaussian.mode_search import find_mode
from bayesreg.inference.layout import flat_position, unravel
from bayesreg.model.observations.images.contrast import contrast_functions, explained_shares, map_contrast
from tests.options import model_of
from tests.phantoms import ball_mesh

MESH = ball_mesh(spacing=30.0)
# mm
EDGE = 2.5


def tissues(seed=0):
    """Four intensities in smooth blobs over the ball, and a little noise."""
    rng = np.random.default_rng(seed)
    low, high = MESH.points.min(0) - 6, MESH.points.max(0) + 6
    shape = np.ceil((high - low) / EDGE).astype(int)
    affine = np.diag([EDGE, EDGE, EDGE, 1.0])
    affine[:3, 3] = low
    blobs = ndimage.gaussian_filter(rng.normal(size=shape), 4)
    levels = np.digitize(blobs, np.quantile(blobs, (0.25, 0.5, 0.75)))
    return Image(ndimage.gaussian_filter(np.array([0.1, 0.4, 0.7, 1.0])[levels], 0.5), affine)


FIXED = tissues()


def other_contrast(voxels):
    """Neither rising nor falling."""
    return np.interp(voxels, [0.1, 0.4, 0.7, 1.0], [0.2, 0.9, 0.5, 0.1])


def test_the_map_at_rest_is_the_contrast_of_the_other_image():
    """The other image is a function of the fixed one, and so the map finds it, but for what it was smoothed by."""
    moving = FIXED.with_voxels(other_contrast(np.asarray(FIXED.voxels)))
    inside = FIXED.voxel_to_world(np.argwhere(np.ones(FIXED.shape)))
    inside = inside[np.linalg.norm(inside - MESH.points.mean(0), axis=1) < 40]
    mapped = map_contrast(FIXED, moving, inside)
    mapped_values, moving_values = (np.asarray(image.interpolate(inside)) for image in (mapped, moving))
    assert np.corrcoef(mapped_values, moving_values)[0, 1] > 0.95
    assert np.corrcoef(np.asarray(FIXED.interpolate(inside)), moving_values)[0, 1] < 0.2


@pytest.mark.long
def test_the_mode_of_a_pair_of_unlike_contrast_is_as_near_as_that_of_one_contrast():
    like_error, unlike_error = error_of(moved(), one_contrast=True), error_of(moved(other_contrast), one_contrast=False)
    # The mesh itself is as coarse as that: it moves by 1.8 mm in the mean.
    assert like_error < 0.3
    assert unlike_error < 1.3 * like_error


def displacement(x):
    away = (x - MESH.points.mean(0)) / 40
    return 2.0 * np.stack([1 - away[..., 1] ** 2, away[..., 0], 0.5 * away[..., 2] ** 2], axis=-1)


def moved(contrast=lambda voxels: voxels):
    """The moving image: m(x + u(x)) = g(f(x)), with u the displacement and g the contrast, and noise."""
    points = FIXED.grid_points()
    # Where what comes to a voxel was.
    x = points.copy()
    for _ in range(30):
        x = points - displacement(x)
    noise = np.random.default_rng(3).normal(scale=0.01, size=FIXED.shape)
    return FIXED.with_voxels(contrast(np.asarray(FIXED.interpolate(x, "cubic"))) + noise)


def error_of(moving, one_contrast, **options):
    model = model_of(preset="registration", fixed={"lam": 10.0, "mu": 1.0}, surface_load=1.0, body_load=0.1)
    pair = br.ImagePair(FIXED, moving, one_contrast=one_contrast, independent_points=None, **options)
    posterior = br.build_posterior(MESH, [pair], model)
    start = flat_position(posterior.target, posterior.data, posterior.estimands(posterior.reference()))
    mode = unravel(posterior.target)(find_mode(posterior.target, np.asarray(start)))
    displacements = posterior.constrain(mode)["u_boundary"]
    return np.linalg.norm(np.asarray(displacements) - displacement(MESH.points), axis=1).mean()


def test_the_functions_of_the_map_are_among_the_unknowns():
    moving = FIXED.with_voxels(other_contrast(np.asarray(FIXED.voxels)))
    pair = br.ImagePair(FIXED, moving, one_contrast=False, quadrature="voxels")
    posterior = br.build_posterior(MESH, [pair])
    basis = np.asarray(posterior.images.shading)
    functions = contrast_functions(FIXED, np.asarray(posterior.images.positions))
    residual = functions - basis @ np.linalg.lstsq(basis, functions, rcond=None)[0]
    assert np.linalg.norm(residual) < 0.01 * np.linalg.norm(functions)
    assert posterior.reference()["images_shading"].shape == (basis.shape[1],)


@pytest.mark.parametrize("similarity", ["lncc"])
def test_a_similarity_with_maps_of_its_own_takes_the_images_as_they_are(similarity):
    pair = br.ImagePair(FIXED, FIXED, one_contrast=False, similarity=similarity, quadrature="voxels")
    assert br.build_posterior(MESH, [pair]).images.shading is None


def test_tissues_of_one_brightness_may_differ_in_the_other_image():
    """Two tissues that are as bright in f, one dark and one bright in m: labels tell them apart, and nothing else."""
    rng = np.random.default_rng(1)
    labels = 1 + (ndimage.gaussian_filter(rng.normal(size=FIXED.shape), 4) > 0).astype(np.int8)
    moving = FIXED.with_voxels(np.where(labels == 1, 0.5 * np.asarray(FIXED.voxels), 1 - np.asarray(FIXED.voxels)))
    inside = FIXED.voxel_to_world(np.argwhere(np.ones(FIXED.shape))[::3])
    tissue = FIXED.with_voxels(labels)
    with_labels, without = (map_contrast(FIXED, moving, inside, label_image) for label_image in (tissue, None))
    values = np.asarray(moving.voxels).ravel()
    assert np.corrcoef(values, np.asarray(with_labels.voxels).ravel())[0, 1] > 0.98
    assert np.corrcoef(values, np.asarray(without.voxels).ravel())[0, 1] < 0.8


def test_labels_on_another_grid_are_refused():
    with pytest.raises(ValueError, match="tissue must lie on the grid"):
        br.ImagePair(FIXED, FIXED, tissue=FIXED.with_voxels(FIXED.voxels).on_orthogonal_grid(2 * FIXED.voxel_sizes, 0))


def test_a_line_and_a_map_explain_what_they_can():
    rng = np.random.default_rng(0)
    intensities = rng.uniform(size=20_000)
    noise = 0.1 * rng.normal(size=intensities.shape)
    line, any_map = explained_shares(intensities, 3 - 2 * intensities + noise)
    assert line == pytest.approx(-(4 / 12) / (4 / 12 + 0.01), abs=0.01)
    assert any_map == pytest.approx(-line, abs=0.01)
    line, any_map = explained_shares(intensities, (intensities - 0.5) ** 2)
    assert abs(line) < 0.01
    assert any_map > 0.99
