"""The transforms that a run leaves, in the hands of other programs: SimpleITK, ANTs, nitransforms and nibabel."""

from dataclasses import replace

import ants
import nibabel as nib
import nitransforms
import numpy as np
import pandas as pd
import pytest
import SimpleITK
from scipy import ndimage
from scipy.spatial.transform import Rotation

from bayesreg.fem.deformation import Deformer
from bayesreg.image import Image
from bayesreg.io.fields import load_displacement
from bayesreg.model.submesh import unresolved_displacement
from bayesreg.model.warp import covered_voxels
from bayesreg.pose import Motion, Pose
from bayesreg.results.displacement_fields import MEAN_STEP, SD_STEP, STEP_AROUND, moments_on, write_transforms
from bayesreg.results.transform import Transform
from tests.phantoms import ball_mesh

CENTRE = np.array([5.0, -3.0, 8.0])
POSE = Motion(np.array([12.0, -3.0, 5.0]), np.array([4.0, 10.0, -6.0])).pose(CENTRE)
TURN = Rotation.from_euler("xyz", (10, -20, 35), degrees=True).as_matrix()
GRIDS = {
    "upright": np.diag([2.0, 2.0, 2.0]),
    "left-handed": np.diag([-2.0, 2.0, 2.0]),
    "anisotropic": np.diag([1.5, 2.0, 4.0]),
    "oblique": TURN @ np.diag([2.0, 2.0, 2.0]),
    "oblique, anisotropic and left-handed": TURN @ np.diag([-1.5, 2.0, 3.0])[:, [1, 0, 2]],
}
LPS = np.array([-1.0, -1.0, 1.0])


def _grid(linear: np.ndarray, margin: float = 50.0) -> Image:
    """A grid about the ball whose voxels are the columns of a matrix."""
    sizes = np.linalg.norm(linear, axis=0)
    shape = np.ceil(2 * margin / sizes).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = linear
    affine[:3, 3] = CENTRE - linear @ ((shape - 1) / 2)
    return Image(np.zeros(shape), affine)


def _transform(pose: Pose = POSE, draws: int = 2) -> Transform:
    mesh, rng = ball_mesh(radius=38, spacing=18.0), np.random.default_rng(0)
    x, y, z = (mesh.points - CENTRE).T / 25
    u = 3.0 * np.stack([np.sin(y), np.cos(z) - 1, x * y / 2], axis=1)
    cells = np.ones(len(mesh.cells))
    unresolved = unresolved_displacement(mesh, 5 * cells, cells, 0.1, 0.2, np.ones(len(mesh.points)))
    return Transform(Deformer(mesh), pose, u, u + 0.3 * rng.standard_normal((draws, *u.shape)), unresolved)


def _smooth_image(grid: Image) -> Image:
    """Smooth enough for linear interpolation to be compared."""
    x, y, z = np.moveaxis(grid.grid_points() - CENTRE, -1, 0) / 20
    return grid.with_voxels(np.sin(x) + np.cos(y + z) + 0.3 * x)


def _to_itk(image: Image) -> SimpleITK.Image:
    itk_image = SimpleITK.GetImageFromArray(np.asarray(image.voxels, np.float64).transpose(2, 1, 0))
    sizes = image.voxel_sizes
    itk_image.SetSpacing(sizes.tolist())
    itk_image.SetOrigin((image.affine[:3, 3] * LPS).tolist())
    itk_image.SetDirection((LPS[:, None] * image.affine[:3, :3] / sizes).ravel().tolist())
    return itk_image


def _of_itk(transform, points):
    return np.array([transform.TransformPoint(point.tolist()) for point in points * LPS]) * LPS


def _place(folder):
    (folder / "transforms").mkdir(exist_ok=True)
    return folder.joinpath


def _lies_between_voxels(image, points):
    """Nearer to the border than the last voxel's centre, programs take what lies beyond for zero, or go on."""
    index = np.asarray(image.world_to_voxel(points))
    return ((index >= 0) & (index <= np.array(image.shape) - 1)).all(axis=-1)


@pytest.mark.parametrize("name", GRIDS)
def test_simpleitk_resamples_and_moves_points_as_we_do(name, tmp_path):
    transform, grid = _transform(), _grid(GRIDS[name])
    write_transforms(_place(tmp_path), transform, grid)
    forward, inverse = (SimpleITK.ReadTransform(str(tmp_path / f"transform_mean{end}.h5")) for end in ("", "_inverse"))
    # On voxel centres the field is exact; the moving image has a grid of its own.
    moving = _smooth_image(Image(np.zeros((45, 60, 50)), POSE.matrix @ _grid(TURN @ np.diag([3.0, 2.0, -2.5])).affine))
    expected = np.asarray(moving.interpolate(transform.place(grid.grid_points().reshape(-1, 3))[0])).reshape(grid.shape)
    by_itk = SimpleITK.Resample(_to_itk(moving), _to_itk(grid), forward, SimpleITK.sitkLinear, np.nan)
    by_itk = SimpleITK.GetArrayFromImage(by_itk).transpose(2, 1, 0)
    finite = np.isfinite(by_itk)
    assert finite.mean() > 0.3
    np.testing.assert_allclose(by_itk[finite], expected[finite], atol=2e-4)
    points = CENTRE + np.random.default_rng(0).uniform(-20, 20, (200, 3))
    placed, _ = transform.place(points)
    coarse = 0.12 if grid.voxel_sizes.max() > 2.5 else 0.06
    assert np.linalg.norm(_of_itk(forward, points) - placed, axis=1).max() < coarse
    assert np.linalg.norm(_of_itk(inverse, placed) - points, axis=1).max() < coarse


@pytest.mark.parametrize("name", ["upright", "oblique, anisotropic and left-handed"])
def test_each_draw_has_its_own(name, tmp_path):
    transform, grid = _transform(), _grid(GRIDS[name])
    write_transforms(_place(tmp_path), transform, grid)
    assert sorted(path.name for path in (tmp_path / "transforms").iterdir()) == [
        f"draw-{draw}{end}" for draw in (1, 2) for end in (".h5", ".nii.gz", "_inverse.h5")
    ]
    points = CENTRE + np.random.default_rng(1).uniform(-20, 20, (100, 3))
    for number, u in enumerate(transform.draws, start=1):
        draw_transform = replace(transform, u_mean=u, draws=transform.draws[:0])
        placed, _ = draw_transform.place(points)
        base = tmp_path / "transforms" / f"draw-{number}"
        forward = SimpleITK.ReadTransform(f"{base}.h5")
        assert np.linalg.norm(_of_itk(forward, points) - placed, axis=1).mean() < 0.1
        inverse = SimpleITK.ReadTransform(f"{base}_inverse.h5")
        assert np.linalg.norm(_of_itk(inverse, placed) - points, axis=1).mean() < 0.1
        header = nib.load(f"{base}.nii.gz").header
        assert int(header["intent_code"]) == 1007
        assert header.get_data_shape()[3:] == (1, 3)
        field = np.stack([component.interpolate(points) for component in load_displacement(f"{base}.nii.gz")], axis=1)
        # What is interpolated holds the pose, which is linear.
        np.testing.assert_allclose(np.linalg.norm(points + field - placed, axis=1).mean(), 0, atol=0.1)


@pytest.mark.parametrize("name", ["anisotropic", "oblique, anisotropic and left-handed"])
def test_ants_nitransforms_and_nibabel_resample_and_move_points_as_we_do(name, tmp_path):
    transform, grid = _transform(), _grid(GRIDS[name])
    write_transforms(_place(tmp_path), transform, grid)
    composite, inverse = (str(tmp_path / f"transform_mean{end}.h5") for end in ("", "_inverse"))
    points = CENTRE + np.random.default_rng(2).uniform(-20, 20, (50, 3))
    placed, _ = transform.place(points)
    for path, start, end in ((composite, points, placed), (inverse, placed, points)):
        table = pd.DataFrame(start * LPS, columns=list("xyz"))
        by_ants = ants.apply_transforms_to_points(3, table, [path])[list("xyz")].to_numpy() * LPS
        by_nitransforms = nitransforms.manip.load(path, fmt="itk").map(start)
        assert np.linalg.norm(by_ants - end, axis=1).max() < 0.12
        assert np.linalg.norm(by_nitransforms - end, axis=1).max() < 0.12

    moving = _smooth_image(Image(np.zeros((45, 60, 50)), POSE.matrix @ _grid(TURN @ np.diag([3.0, 2.0, -2.5])).affine))
    moving_points = transform.place(grid.grid_points().reshape(-1, 3))[0].reshape(*grid.shape, 3)
    expected, interior = np.asarray(moving.interpolate(moving_points)), _lies_between_voxels(moving, moving_points)
    assert interior.mean() > 0.3
    for image, stem in ((grid, "fixed"), (moving, "moving")):
        nib.save(nib.Nifti1Image(np.asarray(image.voxels, np.float64), image.affine), tmp_path / f"{stem}.nii.gz")
    fixed_file, moving_file = tmp_path / "fixed.nii.gz", tmp_path / "moving.nii.gz"

    by_ants = ants.apply_transforms(ants.image_read(str(fixed_file)), ants.image_read(str(moving_file)), [composite])
    np.testing.assert_allclose(by_ants.numpy()[interior], expected[interior], atol=5e-4)
    read = nitransforms.manip.load(composite, fmt="itk")
    by_nitransforms = nitransforms.resampling.apply(read, moving_file, reference=fixed_file, order=1, prefilter=False)
    np.testing.assert_allclose(np.asarray(by_nitransforms.dataobj)[interior], expected[interior], atol=5e-4)


def test_a_field_moves_an_image_by_nibabel_and_scipy_alone(tmp_path):
    transform, grid = _transform(), _grid(GRIDS["oblique, anisotropic and left-handed"])
    write_transforms(_place(tmp_path), transform, grid)
    moving = _smooth_image(Image(np.zeros((45, 60, 50)), POSE.matrix @ _grid(TURN @ np.diag([3.0, 2.0, -2.5])).affine))
    for number, u in enumerate(transform.draws, start=1):
        field = nib.load(tmp_path / "transforms" / f"draw-{number}.nii.gz")
        voxels = np.moveaxis(np.indices(field.shape[:3]), 0, -1)
        places = nib.affines.apply_affine(field.affine, voxels) + field.get_fdata()[..., 0, :] * LPS
        index = nib.affines.apply_affine(np.linalg.inv(moving.affine), places)
        theirs = ndimage.map_coordinates(np.asarray(moving.voxels), np.moveaxis(index, -1, 0), order=1)
        centres = nib.affines.apply_affine(field.affine, voxels).reshape(-1, 3)
        moving_points, _ = replace(transform, u_mean=u, draws=transform.draws[:0]).place(centres)
        interior = _lies_between_voxels(moving, moving_points)
        np.testing.assert_allclose(
            theirs.ravel()[interior], np.asarray(moving.interpolate(moving_points))[interior], atol=5e-4
        )


def test_without_a_pose_and_without_draws(tmp_path):
    transform, grid = _transform(Pose.identity(), draws=0), _grid(GRIDS["upright"])
    write_transforms(tmp_path.joinpath, transform, grid)
    assert {path.name for path in tmp_path.iterdir()} == {"transform_mean.h5", "transform_mean_inverse.h5"}
    x, y, z = load_displacement(tmp_path / "transform_mean.h5")
    expected = transform.mean.displacement(*[grid.grid_points().reshape(-1, 3)] * 1, transform.deformer.locate(
        grid.grid_points().reshape(-1, 3)))  # fmt: skip
    displacements = np.stack([component.voxels for component in (x, y, z)], axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(displacements, expected, atol=2.0**-12)


def test_small_voxels_are_passed_over(tmp_path):
    """A field is linear in a tetrahedron: every third voxel of 0.75 mm says what it is in the others."""
    transform, grid = _transform(), _grid(np.diag([0.75, 2.0, 2.0]))
    write_transforms(_place(tmp_path), transform, grid)
    x, _, _ = load_displacement(tmp_path / "transform_mean.h5")
    np.testing.assert_allclose(x.voxel_sizes, [2.25, 2.0, 2.0])
    assert x.contains(grid.voxel_to_world(np.array([[0.0, 0.0, 0.0], np.array(grid.shape) - 1.0]))).all()
    forward = SimpleITK.ReadTransform(str(tmp_path / "transform_mean.h5"))
    points = CENTRE + np.random.default_rng(2).uniform(-20, 20, (200, 3))
    away = np.linalg.norm(_of_itk(forward, points) - transform.place(points)[0], axis=1)
    assert np.median(away) < 0.01
    assert away.max() < 0.06


@pytest.mark.parametrize(
    ("linear", "around"), [(GRIDS["oblique"], 1e-5), (TURN @ np.diag([0.75, 2.0, 3.0]), 0.05)], ids=["coarse", "fine"]
)
def test_moments_are_those_of_the_draws_and_of_what_the_mesh_cannot_resolve(linear, around):
    """On small voxels, too, where what lies around the mesh is interpolated."""
    transform, grid = _transform(draws=20), _grid(linear)
    mean, total_sd, sd_by_cause = moments = moments_on(transform, grid)
    points = grid.grid_points().reshape(-1, 3)
    covered = covered_voxels(grid, transform.mesh)
    index = tuple(covered.voxel.T)
    away = np.abs(points + mean.reshape(-1, 3) - transform.place(points)[0]).reshape(mean.shape)
    assert away[index].max() < 1e-5
    assert np.percentile(away, 99) < around
    assert away.max() < 5 * around
    corners = transform.mesh.cells[covered.cell]
    nodal_sd = (transform.draws @ transform.pose.rotation.T).std(axis=0, ddof=1)
    interpolated = np.einsum("ka,kai->ki", covered.barycentric, nodal_sd[corners]) ** 2
    unresolved = transform.unresolved.covariance_at(covered.cell, covered.barycentric)
    along = np.einsum("ij,kjl,il->ki", transform.pose.rotation, unresolved, transform.pose.rotation)
    np.testing.assert_allclose(total_sd[index] ** 2, interpolated + along, rtol=1e-4)
    assert sd_by_cause["mesh"] == pytest.approx(np.sqrt(along.mean()), rel=1e-5)
    assert sd_by_cause["nodes"] ** 2 + sd_by_cause["mesh"] ** 2 == pytest.approx(
        (total_sd[index].astype(float) ** 2).mean()
    )
    outside = np.ones(grid.shape, bool)
    outside[index] = False
    assert outside.any()
    assert (total_sd[outside] == 0).all()
    written_mean, written_sd = moments.rounded
    assert np.abs(written_mean - mean)[index].max() <= MEAN_STEP / 2 + 1e-6
    assert np.abs(written_mean - mean).max() <= STEP_AROUND / 2 + 1e-5
    assert np.abs(written_sd - total_sd).max() <= SD_STEP / 2 + 1e-6
    assert ((written_sd > 0).any(axis=-1) == ~outside).all()


def test_a_sheared_grid_gets_one_at_right_angles(tmp_path):
    linear = np.array([[2.0, 0.6, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.5]])
    transform = _transform(draws=0)
    write_transforms(_place(tmp_path), transform, _grid(linear))
    forward = SimpleITK.ReadTransform(str(tmp_path / "transform_mean.h5"))
    points = CENTRE + np.random.default_rng(2).uniform(-20, 20, (50, 3))
    assert np.linalg.norm(_of_itk(forward, points) - transform.place(points)[0], axis=1).max() < 0.12
