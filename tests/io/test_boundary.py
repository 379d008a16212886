"""Boundary displacements from a file: of the nodes, or a field on a grid as ITK writes it."""

from __future__ import annotations

import nibabel as nib
import numpy as np
import pytest
import SimpleITK

import bayesreg as br
from bayesreg.io.displacements import read_boundary, read_start
from bayesreg.io.fields import load_displacement, save_displacement
from bayesreg.model.warp import covered_voxels
from bayesreg.pose import Motion, Pose
from tests.phantoms import ball_mesh, rotated_affine

MESH = ball_mesh(spacing=24.0)
MATRIX = np.array([[0.02, -0.01, 0.03], [0.01, 0.04, 0.0], [-0.02, 0.01, 0.05]])
SHIFT = np.array([1.0, -2.0, 3.0])


def grid(margin=12.0):
    return br.Image(np.zeros((24, 25, 26)), rotated_affine(MESH.points, (24, 25, 26), margin))


def affine_field(points):
    return points @ MATRIX.T + SHIFT


def test_a_field_is_interpolated_at_the_boundary(tmp_path):
    image = grid()
    save_displacement(tmp_path / "u.nii.gz", affine_field(image.grid_points()), image.affine)
    expected = affine_field(MESH.points[MESH.boundary])
    np.testing.assert_allclose(read_boundary(tmp_path / "u.nii.gz", MESH), expected, atol=1e-4)


def test_a_field_of_itk_is_read_in_ras(tmp_path):
    """SimpleITK, which thinks in LPS, writes it."""
    values = np.zeros((4, 5, 6, 3))
    values[:] = (1.0, 2.0, 3.0)  # LPS, mm.
    field = SimpleITK.GetImageFromArray(values, isVector=True)
    field.SetSpacing((2.0, 3.0, 4.0))
    SimpleITK.WriteImage(field, str(tmp_path / "itk.nii.gz"))
    components = load_displacement(tmp_path / "itk.nii.gz")
    assert [np.unique(component.voxels).tolist() for component in components] == [[-1.0], [-2.0], [3.0]]
    np.testing.assert_allclose(components[0].voxel_sizes, (2, 3, 4))


def test_nodes_of_a_run_are_taken_as_they_are(tmp_path):
    u = affine_field(MESH.points)
    br.save_mesh(MESH, tmp_path / "mesh.vtu", {"u_mean": u})
    np.savez(tmp_path / "u.npz", u=u)
    for name in ("mesh.vtu", "u.npz"):
        np.testing.assert_allclose(read_boundary(tmp_path / name, MESH), u[MESH.boundary], rtol=1e-12)


def test_a_field_may_be_where_chains_start(tmp_path):
    """At every node, and less the pose, by which the moving image is laid into the world of the fixed one."""
    image, pose = grid(), Motion(np.array([4.0, -3.0, 2.0]), np.array([5.0, 0.0, -8.0])).pose(np.zeros(3))
    save_displacement(tmp_path / "u.nii.gz", affine_field(image.grid_points()), image.affine)
    np.testing.assert_allclose(
        read_start(tmp_path / "u.nii.gz", MESH, Pose.identity()), affine_field(MESH.points), atol=1e-4
    )
    displaced = MESH.points + affine_field(MESH.points)
    for displacement, nodes in (
        (read_start(tmp_path / "u.nii.gz", MESH, pose), slice(None)),
        (read_boundary(tmp_path / "u.nii.gz", MESH, pose), MESH.boundary),
    ):
        np.testing.assert_allclose(pose.place(MESH.points[nodes] + displacement), displaced[nodes], atol=1e-4)


def test_a_field_that_ends_at_the_boundary_is_refused(tmp_path):
    """As a run's displacement_mean.nii.gz does: it is zero outside the mesh."""
    image = grid()
    voxel = covered_voxels(image, MESH).voxel
    inside = np.zeros((*image.shape, 3))
    inside[tuple(voxel.T)] = affine_field(image.voxel_to_world(voxel))
    save_displacement(tmp_path / "mean.nii.gz", inside, image.affine)
    with pytest.raises(br.types.InputError, match=r"ends at \d+ of the \d+ boundary nodes.* mesh.vtu"):
        read_boundary(tmp_path / "mean.nii.gz", MESH)


def test_a_field_that_goes_to_zero_by_itself_is_taken(tmp_path):
    """A base that rests: zero below some height, and from there on growing with it."""
    image = grid()

    def rising(points):
        return np.maximum(points @ [0.0, 0.0, 0.02], 0.0)[..., None] * SHIFT

    save_displacement(tmp_path / "u.nii.gz", rising(image.grid_points()), image.affine)
    expected = rising(MESH.points[MESH.boundary])
    assert (expected == 0).any()
    np.testing.assert_allclose(read_boundary(tmp_path / "u.nii.gz", MESH), expected, atol=0.1)


def test_a_field_on_a_smaller_grid_is_refused(tmp_path):
    image = grid(margin=-15.0)
    save_displacement(tmp_path / "small.nii.gz", affine_field(image.grid_points()), image.affine)
    with pytest.raises(br.types.InputError, match=r"does not reach \d+ of the \d+ boundary nodes"):
        read_boundary(tmp_path / "small.nii.gz", MESH)


def test_an_image_is_no_field(tmp_path):
    nib.save(nib.Nifti1Image(np.zeros((4, 5, 6), np.float32), np.eye(4)), tmp_path / "image.nii.gz")
    with pytest.raises(br.types.InputError, match=r"expected the shape \(X, Y, Z, 1, 3\)"):
        read_boundary(tmp_path / "image.nii.gz", MESH)
