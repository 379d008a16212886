"""Intensities in two bytes each."""

import nibabel as nib
import numpy as np

from bayesreg.image import Image, IntensityScale
from bayesreg.io.intensities import LEVEL, in_levels, save_in_levels
from bayesreg.io.volumes import load_image


def _image(greatest: float) -> Image:
    voxels = np.random.default_rng(0).uniform(-0.2, greatest, (7, 6, 5))
    return Image(voxels, np.diag([1.0, 2.0, 3.0, 1.0]))


def test_what_is_read_is_what_was_rounded(tmp_path):
    """To the last bit: a resumed run sees the same numbers. Beyond the range of two bytes, too."""
    for greatest, kind in ((1.1, np.int16), (20.0, np.float32)):
        image = in_levels(_image(greatest))
        assert np.abs(image.voxels - _image(greatest).voxels).max() <= LEVEL / 2
        save_in_levels(image, tmp_path / "image.nii.gz")
        assert nib.load(tmp_path / "image.nii.gz").get_data_dtype() == kind
        read = in_levels(load_image(tmp_path / "image.nii.gz"))
        assert read.voxels.dtype == np.float32
        np.testing.assert_array_equal(read.voxels, image.voxels)


def test_a_scale_is_undone_in_the_file(tmp_path):
    scale = IntensityScale(30.0, 430.0)
    for greatest in (1.1, 20.0):
        image = _image(greatest)
        save_in_levels(image, tmp_path / "image.nii.gz", scale)
        stored = np.asarray(nib.load(tmp_path / "image.nii.gz").dataobj)
        np.testing.assert_allclose(stored, scale.undo(image).voxels, atol=400 * LEVEL)
