"""Images: world coordinates, interpolation against SciPy, gradients, intensity scale."""

import jax
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from bayesreg.image import Image, robust_scale

SHAPE = (9, 12, 7)
MODES = {"linear": {"order": 1, "mode": "nearest"}, "cubic": {"order": 3, "mode": "mirror"}}


def affine_of(angles=(0.0, 0.0, 0.0), sizes=(1.0, 1.0, 1.0), flip=False, shear=0.0, origin=(-20.0, 7.0, 3.0)):
    matrix = Rotation.from_euler("xyz", angles, degrees=True).as_matrix() * sizes
    matrix[:, 0] *= -1 if flip else 1
    matrix[:, 1] += shear * matrix[:, 0]
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = matrix, origin
    return affine


AFFINES = {
    "upright": affine_of(),
    "anisotropic": affine_of(sizes=(0.7, 1.3, 3.1)),
    "left-handed": affine_of(sizes=(1.0, 0.8, 1.2), flip=True),
    "oblique": affine_of(angles=(20.0, -35.0, 50.0), sizes=(0.9, 1.1, 2.0)),
    "oblique left-handed": affine_of(angles=(-70.0, 15.0, 130.0), sizes=(1.5, 0.6, 1.0), flip=True),
    "axes permuted": affine_of(angles=(90.0, 0.0, 90.0), sizes=(1.0, 2.0, 3.0)),
    "sheared": affine_of(angles=(10.0, 0.0, 0.0), shear=0.3),
}


@pytest.fixture(params=AFFINES.values(), ids=AFFINES.keys())
def image(request):
    return Image(np.random.default_rng(0).normal(size=SHAPE), request.param)


def indices_inside(count=200, seed=1):
    return np.random.default_rng(seed).uniform(0, np.array(SHAPE) - 1, (count, 3))


class TestMaking:
    @pytest.mark.parametrize(
        ("voxels", "affine", "message"),
        [
            (np.zeros((3, 3)), np.eye(4), r"3D array .* got shape \(3, 3\)"),
            (np.zeros((3, 3, 3, 2)), np.eye(4), r"got shape \(3, 3, 3, 2\)"),
            (np.zeros((0, 3, 3)), np.eye(4), "non-empty"),
            (np.zeros((2, 2, 2)), np.eye(3), "4 × 4"),
            (np.zeros((2, 2, 2)), np.eye(4) * np.nan, "finite 4 × 4"),
            (np.zeros((2, 2, 2)), np.ones((4, 4)), "last row"),
            (np.zeros((2, 2, 2)), np.diag([1.0, 1.0, 0.0, 1.0]), "singular"),
            (np.full((2, 2, 2), np.nan), np.eye(4), "8 voxels are NaN or infinite"),
        ],
    )
    def test_says_what_is_wrong(self, voxels, affine, message):
        with pytest.raises(ValueError, match=message):
            Image(voxels, affine)

    def test_another_image_on_the_grid_must_fit_it(self, image):
        with pytest.raises(ValueError, match=r"expected voxels of shape \(9, 12, 7\), got \(2, 2, 2\)"):
            image.with_voxels(np.zeros((2, 2, 2)))


class TestWorld:
    def test_follows_the_affine(self, image):
        index = np.array([2.0, 5.0, 1.0])
        np.testing.assert_allclose(image.voxel_to_world(index), (image.affine @ [*index, 1])[:3])

    def test_there_and_back(self, image):
        indices = indices_inside()
        np.testing.assert_allclose(image.world_to_voxel(image.voxel_to_world(indices)), indices, atol=1e-10)

    def test_grid_points_hold_every_voxel_centre(self, image):
        points = image.grid_points()
        assert points.shape == (*SHAPE, 3)
        np.testing.assert_allclose(points[3, 7, 2], (image.affine @ [3, 7, 2, 1])[:3])

    def test_contains_the_extent_of_its_voxels(self, image):
        last = np.array(SHAPE) - 1.0
        inside = np.array([[-0.49, 0, 0], [0, 0, 0], last + 0.49])
        outside = np.array([[-0.51, 0, 0], (last[0], last[1], last[2] + 0.51), [0, -3, 0]])
        assert image.contains(image.voxel_to_world(inside)).all()
        assert not image.contains(image.voxel_to_world(outside)).any()


def test_voxel_sizes_and_volume():
    image = Image(np.zeros((2, 2, 2)), affine_of(angles=(30.0, 40.0, 50.0), sizes=(0.5, 2.0, 3.0), flip=True))
    np.testing.assert_allclose(image.voxel_sizes, (0.5, 2.0, 3.0))
    assert image.voxel_volume == pytest.approx(3.0)


@pytest.mark.parametrize("method", MODES)
class TestInterpolation:
    def test_equals_scipy_inside(self, image, method):
        indices = indices_inside()
        expected = ndimage.map_coordinates(image.voxels, indices.T, **MODES[method])
        np.testing.assert_allclose(image.interpolate(image.voxel_to_world(indices), method), expected, atol=1e-10)

    def test_passes_through_the_voxels(self, image, method):
        np.testing.assert_allclose(image.interpolate(image.grid_points(), method), image.voxels, atol=1e-10)

    def test_continues_with_the_nearest_value_outside(self, image, method):
        beyond = indices_inside() * 3 - np.array(SHAPE)
        nearest = np.clip(beyond, 0, np.array(SHAPE) - 1)
        outside = image.interpolate(image.voxel_to_world(beyond), method)
        np.testing.assert_allclose(outside, image.interpolate(image.voxel_to_world(nearest), method), atol=1e-10)

    def test_gradient_equals_differences(self, image, method):
        points = image.voxel_to_world(indices_inside(20) // 1 + 0.4)
        value = image.interpolator(method)
        gradient = jax.vmap(jax.grad(value))(points)
        step = 1e-5 * np.eye(3)
        differences = np.stack([(value(points + e) - value(points - e)) / 2e-5 for e in step], axis=-1)
        np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-7)

    def test_chains_side_by_side_are_each_by_itself(self, image, method):
        """More points than are looked at together, and their values, slopes and, of cubic ones, second derivatives."""
        value = image.interpolator(method)
        points = image.voxel_to_world(indices_inside(3 * 1500).reshape(3, 1500, 3))

        def energy(x):
            return (value(x) ** 2).sum()

        every = jax.vmap(jax.value_and_grad(energy))(points)
        for chain in range(3):
            height, slope = jax.value_and_grad(energy)(points[chain])
            np.testing.assert_allclose(every[0][chain], height, rtol=1e-12)
            np.testing.assert_allclose(every[1][chain], slope, rtol=1e-9, atol=1e-12)
        if method == "cubic":
            few = points[:, :4]
            curved = jax.vmap(jax.hessian(energy))(few)
            np.testing.assert_allclose(curved[2], jax.hessian(energy)(few[2]), rtol=1e-9, atol=1e-12)
        assert jax.vmap(value)(np.zeros((2, 0, 3))).shape == (2, 0)

    def test_gradient_vanishes_outside(self, image, method):
        point = image.voxel_to_world(np.array([-4.0, 2.3, -2.0]))
        np.testing.assert_allclose(
            image.affine[:3, [0, 2]].T @ jax.grad(image.interpolator(method))(point), 0, atol=1e-9
        )

    def test_takes_any_batch_of_points_under_jit(self, image, method):
        points = image.voxel_to_world(indices_inside(24).reshape(2, 3, 4, 3))
        values = jax.jit(lambda interpolator, x: interpolator(x))(image.interpolator(method), points)
        assert values.shape == (2, 3, 4)
        np.testing.assert_allclose(values[1, 2], image.interpolate(points[1, 2], method), atol=1e-12)

    def test_reads_integers_as_numbers(self, image, method):
        integers = np.rint(10 * image.voxels)
        points = image.voxel_to_world(indices_inside())
        from_integers = image.with_voxels(integers.astype(np.int16)).interpolate(points, method)
        np.testing.assert_allclose(from_integers, image.with_voxels(integers).interpolate(points, method), atol=1e-12)

    @pytest.mark.parametrize("shape", [(1, 5, 4), (2, 2, 2), (1, 1, 1)])
    def test_works_on_thin_images(self, method, shape):
        thin = Image(np.random.default_rng(0).normal(size=shape), AFFINES["oblique"])
        np.testing.assert_allclose(thin.interpolate(thin.grid_points(), method), thin.voxels, atol=1e-10)


def test_linear_interpolation_reproduces_a_linear_function(image):
    slope = np.array([0.3, -1.2, 2.0])
    linear = image.with_voxels(image.grid_points() @ slope + 4)
    points = image.voxel_to_world(indices_inside())
    np.testing.assert_allclose(linear.interpolate(points), points @ slope + 4, atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 1024, 2051])
def test_any_number_of_points_has_the_values_and_gradients_of_each(count):
    """They are looked at in batches."""
    image = Image(np.random.default_rng(0).normal(size=SHAPE), AFFINES["oblique"])
    points, value = image.voxel_to_world(indices_inside(count)), image.interpolator("cubic")
    expected = ndimage.map_coordinates(image.voxels, indices_inside(count).T, **MODES["cubic"])
    values, gradients = jax.value_and_grad(lambda x: (lambda v: (v.sum(), v))(value(x)), has_aux=True)(points)
    np.testing.assert_allclose(values[1], expected, atol=1e-10)
    if count:
        last = jax.grad(value)(points[-1])
        np.testing.assert_allclose(gradients[-1], last, rtol=1e-12)


def test_cubic_gradient_is_continuous_across_voxels():
    image = Image(np.random.default_rng(0).normal(size=SHAPE), np.eye(4))
    slope = jax.grad(image.interpolator("cubic"))
    below, above = (slope(np.array([4.0 + side, 5.3, 2.6])) for side in (-1e-9, 1e-9))
    np.testing.assert_allclose(below, above, atol=1e-6)


class TestRobustScale:
    def test_maps_the_quantiles_to_zero_and_one(self):
        values = np.random.default_rng(0).normal(100, 20, (20, 20, 20))
        scaled = robust_scale(Image(values, np.eye(4)))(Image(values, np.eye(4)))
        np.testing.assert_allclose(np.quantile(scaled.voxels, (0.005, 0.995)), (0, 1), atol=1e-12)

    def test_looks_inside_the_mask_only(self):
        values = np.random.default_rng(0).uniform(size=(10, 10, 10))
        mask = values < 0.5
        scale = robust_scale(Image(values, np.eye(4)), mask)
        np.testing.assert_allclose((scale.low, scale.high), np.quantile(values[mask], (0.005, 0.995)))

    def test_one_scale_keeps_two_images_comparable(self):
        a = Image(np.linspace(0, 10, 27).reshape(3, 3, 3), np.eye(4))
        b = a.with_voxels(a.voxels + 5)
        scale = robust_scale(a)
        np.testing.assert_allclose(scale(b).voxels - scale(a).voxels, 5 / (scale.high - scale.low))

    def test_does_not_clip(self):
        image = Image(np.append(np.linspace(0, 1, 999), 1e3).reshape(10, 10, 10), np.eye(4))
        assert robust_scale(image)(image).voxels.max() > 100

    def test_refuses_an_empty_mask(self):
        with pytest.raises(ValueError, match="empty"):
            robust_scale(Image(np.ones((2, 2, 2)), np.eye(4)), np.zeros((2, 2, 2), bool))

    def test_refuses_an_image_without_contrast(self):
        with pytest.raises(ValueError, match="no contrast"):
            robust_scale(Image(np.ones((2, 2, 2)), np.eye(4)))
