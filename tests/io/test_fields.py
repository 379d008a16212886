"""Displacement fields by the conventions of those who write them: one motion, and each of its files."""

import nibabel as nib
import numpy as np
import pytest
import SimpleITK

from bayesreg.image import Image
from bayesreg.io.fields import load_displacement, save_displacement
from tests.test_image import AFFINES

SHAPE = (5, 6, 4)
RIGID = {name: affine for name, affine in AFFINES.items() if name != "sheared"}
AFFINE = RIGID["oblique left-handed"]
GRID = Image(np.zeros(SHAPE), AFFINE)
VECTOR = np.array([1.5, -2.0, 4.0])
FIELD = VECTOR + 0.05 * GRID.grid_points() @ np.array([[1.0, 2, 0], [0, -1, 1], [0.5, 0, 1]])
LPS = np.array([-1, -1, 1])


def write(path, vectors, code=0, name="", parameters=(), axes=5):
    """A NIfTI file of vectors with an intent."""
    vectors = vectors[:, :, :, None] if axes == 5 else vectors
    image = nib.Nifti1Image(vectors.astype(np.float32), AFFINE)
    image.header["intent_code"], image.header["intent_name"] = code, name
    for number, value in enumerate(parameters, start=1):
        image.header[f"intent_p{number}"] = value
    nib.save(image, path)
    return path


def itk_field():
    image = SimpleITK.GetImageFromArray((FIELD * LPS).transpose(2, 1, 0, 3).copy(), isVector=True)
    sizes = np.linalg.norm(AFFINE[:3, :3], axis=0)
    image.SetSpacing(sizes.tolist())
    image.SetDirection((np.diag(LPS) @ AFFINE[:3, :3] / sizes).ravel().tolist())
    image.SetOrigin((LPS * AFFINE[:3, 3]).tolist())
    return image


def of_itk(path):
    SimpleITK.WriteImage(itk_field(), str(path))
    return path


def of_itk_as_transform(path):
    SimpleITK.WriteTransform(SimpleITK.DisplacementFieldTransform(itk_field()), str(path))
    return path


PLACES = FIELD + GRID.grid_points()


@pytest.mark.parametrize(
    "make",
    [
        lambda f: write(f / "itk.nii.gz", FIELD * LPS, 1007),
        lambda f: write(f / "bare.nii.gz", FIELD * LPS),
        lambda f: write(f / "four_axes.nii.gz", FIELD * LPS, axes=4),
        lambda f: write(f / "freesurfer.nii.gz", FIELD, 1006),
        lambda f: write(f / "niftyreg_displacements.nii.gz", FIELD, 1007, "NREG_TRANS", (1,)),
        lambda f: write(f / "niftyreg_places.nii.gz", PLACES, 1007, "NREG_TRANS", (0,)),
        lambda f: write(f / "y_spm.nii", PLACES, 1007, "Mapping"),
        lambda f: of_itk(f / "itk.nrrd"),
        lambda f: of_itk(f / "itk.mha"),
        lambda f: of_itk_as_transform(f / "itk.h5"),
        lambda f: of_itk_as_transform(f / "itk.tfm"),
    ],
)
def test_every_convention_gives_the_same_displacement(tmp_path, make):
    components = load_displacement(make(tmp_path))
    np.testing.assert_allclose(components[0].affine, AFFINE, atol=1e-4)
    np.testing.assert_allclose(np.stack([component.voxels for component in components], axis=-1), FIELD, atol=1e-4)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda f: write(f / "a.nii", FIELD, 2006), "FSL"),
        (lambda f: write(f / "a.nii", FIELD, 1007, "NREG_TRANS", (3,)), "NiftyReg's NREG_TRANS of kind 3"),
        (lambda f: write(f / "a.nii", FIELD[..., :2]), "is no displacement field: expected the shape"),
        (lambda f: f / "gone.h5", "there is no such file"),
        (lambda f: f / "gone.nii", "there is no such file"),
    ],
)
def test_what_is_no_field_is_refused(tmp_path, make, match):
    with pytest.raises(ValueError, match=match):
        load_displacement(make(tmp_path))


def test_an_affine_transform_is_no_field(tmp_path):
    SimpleITK.WriteTransform(SimpleITK.AffineTransform(3), str(tmp_path / "a.tfm"))
    with pytest.raises(ValueError, match="holds no displacement field"):
        load_displacement(tmp_path / "a.tfm")


def test_a_composite_of_a_rigid_motion_and_a_field_is_one_field(tmp_path):
    """As ANTs writes it: points go through the last that was added first."""
    rigid = SimpleITK.Euler3DTransform((0.0, 0.0, 0.0), 0.1, -0.05, 0.2, (3.0, -2.0, 1.0))
    composite = SimpleITK.CompositeTransform([rigid, SimpleITK.DisplacementFieldTransform(itk_field())])
    SimpleITK.WriteTransform(composite, str(tmp_path / "both.h5"))
    components = load_displacement(tmp_path / "both.h5")
    voxel = np.array([2, 2, 1])
    point = components[0].voxel_to_world(voxel.astype(float))
    expected = np.array(composite.TransformPoint((point * LPS).tolist())) * LPS - point
    np.testing.assert_allclose([float(component.voxels[tuple(voxel)]) for component in components], expected, atol=1e-6)


def test_file_holds_lps_vectors(tmp_path):
    save_displacement(tmp_path / "u.nii.gz", np.tile(VECTOR, (*SHAPE, 1)), np.eye(4))
    source = nib.load(tmp_path / "u.nii.gz")
    assert source.shape == (*SHAPE, 1, 3)
    assert source.header["intent_code"] == 1007
    np.testing.assert_allclose(np.asarray(source.dataobj)[0, 0, 0, 0], (-1.5, 2.0, 4.0))


@pytest.mark.parametrize("affine", RIGID.values(), ids=RIGID.keys())
def test_simpleitk_moves_points_by_it(tmp_path, affine):
    grid = Image(np.zeros(SHAPE), affine)
    save_displacement(tmp_path / "u.nii.gz", FIELD, affine)
    source = SimpleITK.ReadImage(str(tmp_path / "u.nii.gz"), SimpleITK.sitkVectorFloat64)
    transform = SimpleITK.DisplacementFieldTransform(source)
    point = grid.voxel_to_world(np.array([2.0, 3.0, 1.0]))
    moved = np.array(transform.TransformPoint(tuple((point * LPS).tolist()))) * LPS
    np.testing.assert_allclose(moved - point, FIELD[2, 3, 1], atol=1e-4)
