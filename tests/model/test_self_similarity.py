"""Pairs that are compared by what places look like beside their neighbours."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayesreg as br
from bayesreg.image import Image
from bayesreg.model.observations.images.self_similarity import PATCH, AlternatingImages, describe_self_similarity
from tests.model.test_contrast import FIXED, MESH, error_of, moved, other_contrast
from tests.model.test_gradients import assert_gradient
from tests.options import posterior_of

RNG = np.random.default_rng(0)
DISTANCE = 1.5


def small_image():
    return Image(RNG.normal(size=(15, 14, 13)), np.diag([1.5, 1.5, 1.5, 1.0]))


def test_descriptors_are_those_of_loops():
    """Patches, distances and descriptors by their definition, at one voxel that is far from the borders."""
    image, voxel = small_image(), np.array([7, 7, 6])
    voxels = np.asarray(image.voxels)
    # As far as SciPy's kernel goes.
    reach = range(-2, 3)
    offsets = np.array([(i, j, k) for i in reach for j in reach for k in reach])
    weights = np.exp(-0.5 * (offsets**2).sum(axis=1) / PATCH**2)
    weights /= weights.sum()
    steps = [np.array(step) for step in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))]
    distances = []
    for step in steps:
        patch, shifted_patch = (tuple((voxel + offsets + shift).T) for shift in (0, step))
        distances.append(weights @ (voxels[patch] - voxels[shifted_patch]) ** 2)
    expected = np.exp(-(np.array(distances) - min(distances)) / np.mean(distances))
    descriptors = describe_self_similarity(image, np.eye(3), DISTANCE)
    np.testing.assert_allclose(
        [float(descriptor.voxels[tuple(voxel)]) for descriptor in descriptors], expected, rtol=1e-6
    )


@pytest.mark.parametrize(("gain", "offset"), [(300.0, 20.0), (-2.0, 1.0)])
def test_gain_offset_and_an_inverted_contrast_change_nothing(gain, offset):
    image = small_image()
    changed = image.with_voxels(gain * np.asarray(image.voxels) + offset)
    for descriptor, changed_descriptor in zip(
        *(describe_self_similarity(x, np.eye(3), DISTANCE) for x in (image, changed)), strict=True
    ):
        np.testing.assert_allclose(descriptor.voxels, changed_descriptor.voxels, rtol=1e-6)


def test_neighbours_lie_in_the_world_and_not_on_a_grid():
    """The same image in another order of the axes, one of them reversed, has the same descriptors in the world."""
    image = small_image()
    voxels = np.asarray(image.voxels)
    turned = np.ascontiguousarray(np.transpose(voxels, (2, 0, 1))[:, ::-1])
    affine = np.zeros((4, 4))
    # Voxel (i, j, k) of the turned image is voxel (n − 1 − j, k, i) of the other.
    affine[:3, 0], affine[:3, 1], affine[:3, 2] = (image.affine[:3, axis] for axis in (2, 0, 1))
    affine[:3, 3] = image.affine[:3, 3] + (len(voxels) - 1) * image.affine[:3, 0]
    affine[:3, 1] *= -1
    affine[3, 3] = 1
    descriptors = describe_self_similarity(image, np.eye(3), DISTANCE)
    again = describe_self_similarity(Image(turned, affine), np.eye(3), DISTANCE)
    for descriptor, turned_descriptor in zip(descriptors, again, strict=True):
        np.testing.assert_allclose(
            np.transpose(np.asarray(descriptor.voxels), (2, 0, 1))[:, ::-1], turned_descriptor.voxels, rtol=1e-6
        )


def test_a_constant_image_is_like_itself_everywhere():
    for descriptor in describe_self_similarity(small_image().with_voxels(np.ones((15, 14, 13))), np.eye(3), DISTANCE):
        assert (np.asarray(descriptor.voxels) == 1).all()


@pytest.mark.parametrize("count", [17, 18, 1])
def test_images_take_turns(count):
    images = [small_image().interpolator("cubic") for _ in range(6)]
    points = jnp.asarray(RNG.uniform(2, 18, (count, 3)))
    turns = AlternatingImages.of(images)
    expected = [images[q % 6](points[q]) for q in range(count)]
    np.testing.assert_allclose(turns(points), expected, rtol=1e-12)
    slope = jax.grad(lambda x: turns(x).sum())(points)
    np.testing.assert_allclose(slope, [jax.grad(images[q % 6])(points[q]) for q in range(count)], rtol=1e-9)


def posterior(**options):
    moving = FIXED.with_voxels(other_contrast(np.asarray(FIXED.voxels)))
    return posterior_of(FIXED, moving, MESH, similarity="mind", interpolation="cubic", **options)


def test_the_gradient_is_that_of_differences():
    post = posterior(quadrature="gauss32")
    assert_gradient(post.logdensity, post.initial(jax.random.key(0)))


def test_the_energy_is_that_of_one_descriptor_at_each_point():
    post = posterior(quadrature="gauss32")
    term = post.data.terms["images"]
    values = post.constrain(post.initial(jax.random.key(1)))
    places = np.asarray(term.places(post.evaluate(values).u))
    pairs = post.observations["images"].descriptors
    fixed, moving = (
        np.array([np.asarray(pairs[k][which].interpolate(x[k::6], "cubic")) for k in range(6)], dtype=object)
        for which, x in ((0, np.asarray(term.positions)), (1, places))
    )
    weights = np.asarray(term.quadrature.weights)
    expected = sum(weights[k::6] @ (fixed[k] - moving[k]).astype(float) ** 2 for k in range(6))
    assert float(post.energies(values)["similarity_energy"]) == pytest.approx(expected, rel=1e-6)


def test_the_curvature_is_the_hessian():
    """Against differences of the gradient."""
    post = posterior(quadrature="gauss32", fixed={"lam": 10.0, "mu": 1.0}, rigid_sd=0.5)
    u = post.constrain(post.initial(jax.random.key(1)))["u_boundary"]
    hessian = post.target.mode_search.curvature(post.data, {"u_boundary": u})
    values = post.reference()
    slope = jax.jit(jax.grad(lambda u: -post.logdensity_constrained({**values, "u_boundary": u})))
    for direction in RNG.normal(size=(3, *u.shape)):
        ahead, behind = (slope(u + sign * 1e-4 * direction) for sign in (1, -1))
        expected = np.ravel(ahead - behind) / 2e-4
        np.testing.assert_allclose(
            (hessian.gauss_newton + hessian.remainder) @ direction.ravel(), expected, atol=1e-3 * abs(expected).max()
        )
    assert np.linalg.eigvalsh(hessian.gauss_newton).min() > 0


@pytest.mark.long
def test_the_mode_of_a_pair_of_unlike_contrast_is_near():
    assert error_of(moved(other_contrast), one_contrast=False, similarity="mind") < 0.5


def test_what_is_ignored_stays_so():
    bright = FIXED.with_voxels(np.asarray(FIXED.voxels) > 0.9)
    masked, all_of_it = (
        br.ImagePair(FIXED, FIXED, fixed_ignore=mask, similarity="mind", quadrature="voxels").on(MESH).term
        for mask in (bright, None)
    )
    assert len(masked.positions) < len(all_of_it.positions)


def test_a_map_of_intensities_is_refused_beside_it():
    with pytest.raises(ValueError, match="maps of its own"):
        br.ImagePair(FIXED, FIXED, similarity="mind", intensity_map=2)
