"""Files as users have them: other formats, and headers whose two forms, units or offsets are at odds."""

import gzip
import struct

import nibabel as nib
import numpy as np
import pytest
import SimpleITK

from bayesreg.image import Image
from bayesreg.io.readers import corners_apart, other_form, read_volume
from bayesreg.io.volumes import load_image
from tests.test_image import AFFINES

SHAPE = (5, 6, 4)
VOXELS = np.random.default_rng(0).integers(0, 200, SHAPE).astype(np.float32)
AFFINE = AFFINES["oblique left-handed"]
LPS = np.diag([-1, -1, 1, 1.0])


def itk_image(voxels=VOXELS, affine=AFFINE):
    image = SimpleITK.GetImageFromArray(voxels.transpose(2, 1, 0).copy())
    sizes = np.linalg.norm(affine[:3, :3], axis=0)
    image.SetSpacing(sizes.tolist())
    image.SetDirection((LPS[:3, :3] @ affine[:3, :3] / sizes).ravel().tolist())
    image.SetOrigin((LPS @ affine)[:3, 3].tolist())
    return image


def nifti(path, change=lambda header: None, affine=AFFINE):
    """A file whose header was changed after the making, in its bytes."""
    nib.save(nib.Nifti1Image(VOXELS, affine), path)
    raw = bytearray(path.read_bytes())
    header = np.frombuffer(raw, nib.nifti1.header_dtype, 1).copy()[0]
    change(header)
    raw[:348] = header.tobytes()
    path.write_bytes(bytes(raw))
    return path


def check(volume, affine=AFFINE):
    np.testing.assert_array_equal(volume.voxels, VOXELS)
    np.testing.assert_allclose(volume.affine, affine, atol=1e-4)


@pytest.mark.parametrize("suffix", [".nrrd", ".mha", ".mhd", ".nii.gz"])
def test_simpleitk_s_formats_lie_where_simpleitk_puts_them(tmp_path, suffix):
    SimpleITK.WriteImage(itk_image(), str(tmp_path / f"a{suffix}"))
    check(read_volume(tmp_path / f"a{suffix}"))


def test_mgz(tmp_path):
    nib.save(nib.MGHImage(VOXELS, AFFINE), tmp_path / "a.mgz")
    check(read_volume(tmp_path / "a.mgz"))


def dicom(folder, series="1.2.3.4"):
    """A series of slices, one file each."""
    folder.mkdir(exist_ok=True)
    affine = np.diag([2.0, 2.0, 3.0, 1.0])
    image = SimpleITK.Cast(itk_image(affine=affine), SimpleITK.sitkInt16)
    writer = SimpleITK.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for number in range(SHAPE[2]):
        one = image[:, :, number]
        position = "\\".join(map(str, image.TransformIndexToPhysicalPoint((0, 0, number))))
        axes = "\\".join(map(str, np.reshape(image.GetDirection(), (3, 3)).T[:2].ravel()))
        tags = {
            "0008|0060": "MR",
            "0020|000e": series,
            "0020|0032": position,
            "0020|0037": axes,
            "0020|0013": str(number),
            "0018|0050": "3",
        }
        for tag, value in tags.items():
            one.SetMetaData(tag, value)
        writer.SetFileName(str(folder / f"{series}_{number}.dcm"))
        writer.Execute(one)
    return affine


def test_a_dicom_folder(tmp_path):
    affine = dicom(tmp_path / "series")
    check(read_volume(tmp_path / "series"), affine)


def test_a_folder_without_one_series_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds 0 DICOM series; expected one"):
        read_volume(tmp_path)
    dicom(tmp_path)
    dicom(tmp_path, series="1.2.3.5")
    with pytest.raises(ValueError, match=r"holds 2 DICOM series: 1\.2\.3"):
        read_volume(tmp_path)


def test_forms_at_odds_are_told_and_the_s_form_is_taken(tmp_path, caplog):
    source = nib.Nifti1Image(VOXELS, None)
    sform = np.diag([1.05, 1.02, 1.08, 1.0]) @ AFFINE
    source.set_sform(sform, 4)
    source.set_qform(AFFINE, 1)
    nib.save(source, tmp_path / "a.nii")
    volume = read_volume(tmp_path / "a.nii")
    check(volume, sform)
    np.testing.assert_allclose(volume.other_affine, AFFINE, atol=1e-4)
    np.testing.assert_allclose(other_form(tmp_path / "a.nii"), AFFINE, atol=1e-4)
    assert f"corners up to {corners_apart(sform, AFFINE, SHAPE):.3g} mm apart; the s-form is taken" in caplog.text


def test_forms_that_agree_are_not_mentioned(tmp_path, caplog):
    assert read_volume(nifti(tmp_path / "a.nii")).other_affine is None
    assert not caplog.records


@pytest.mark.parametrize(("unit", "scale"), [("micron", 1000.0), ("meter", 0.001)])
def test_units_are_converted_as_itk_does(tmp_path, caplog, unit, scale):
    source = nib.Nifti1Image(VOXELS, np.diag([scale] * 3 + [1.0]) @ AFFINE)
    source.header.set_xyzt_units(unit)
    nib.save(source, tmp_path / "a.nii")
    check(read_volume(tmp_path / "a.nii"))
    assert f"units of a {unit}, converted to mm" in caplog.text
    spacing = SimpleITK.ReadImage(str(tmp_path / "a.nii")).GetSpacing()
    np.testing.assert_allclose(spacing, Image(VOXELS, AFFINE).voxel_sizes, rtol=1e-4)


def test_an_analyze_pair_does_not_tell_left_from_right(tmp_path, caplog):
    nib.save(nib.AnalyzeImage(VOXELS, np.diag([2.0, 2.0, 2.0, 1.0])), tmp_path / "a.img")
    volume = read_volume(tmp_path / "a.img")
    np.testing.assert_array_equal(volume.voxels, VOXELS)
    assert "does not tell left from right" in caplog.text
    assert ("to the left" in caplog.text) == (volume.affine[0, 0] < 0)


@pytest.mark.parametrize("zipped", [False, True])
def test_an_offset_inside_the_header_is_not_believed(tmp_path, caplog, zipped):
    path = nifti(tmp_path / "a.nii", lambda header: header.__setitem__("vox_offset", 0))
    if zipped:
        (tmp_path / "a.nii.gz").write_bytes(gzip.compress(path.read_bytes()))
        path = tmp_path / "a.nii.gz"
    check(read_volume(path))
    assert "read from byte 352 on" in caplog.text


def test_an_offset_of_zero_keeps_the_scale(tmp_path):
    source = nib.Nifti1Image(VOXELS.astype(np.int16), AFFINE)
    source.header.set_slope_inter(0.5, 10)
    nib.save(source, tmp_path / "a.nii")
    raw = bytearray((tmp_path / "a.nii").read_bytes())
    raw[108:112] = struct.pack("<f", 0.0)
    (tmp_path / "a.nii").write_bytes(bytes(raw))
    np.testing.assert_allclose(load_image(tmp_path / "a.nii").voxels, 10 + 0.5 * VOXELS)


def unit_quaternion(header):
    """Of half a turn about x, rounded up."""
    header["sform_code"], header["qform_code"] = 0, 1
    header["quatern_b"], header["quatern_c"], header["quatern_d"] = 1.0000004, 0, 0
    header["pixdim"][:4] = 1, 2, 2, 2
    for axis, offset in zip("xyz", (3, 4, 5), strict=True):
        header[f"qoffset_{axis}"] = offset


def zero_sform(header):
    header["qform_code"] = 1
    for row in "xyz":
        header[f"srow_{row}"] = 0


def trailing_zero(header):
    header["dim"][:6] = 4, *SHAPE, 0, 1


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (unit_quaternion, "SimpleITK has read it"),
        (zero_sform, "its q-form is taken"),
        (trailing_zero, "SimpleITK has read it"),
    ],
)
def test_headers_that_simpleitk_reads_are_read_as_it_does(tmp_path, caplog, change, told):
    path = nifti(tmp_path / "a.nii", change)
    other = SimpleITK.ReadImage(str(path))
    volume = load_image(path)
    np.testing.assert_array_equal(volume.voxels, VOXELS)
    for index in ((0, 0, 0), (4, 0, 1), (2, 5, 3)):
        ras = np.array(other.TransformIndexToPhysicalPoint(index)) * (-1, -1, 1)
        np.testing.assert_allclose(volume.voxel_to_world(np.array(index, float)), ras, atol=1e-3)
    assert told in caplog.text


@pytest.mark.parametrize("name", ["a.PAR", "a.HEAD", "a.nii.zst", "a.mgz", "a.nrrd", "a.mha", "a.nii", "a.mnc"])
def test_what_no_reader_understands_is_one_message(tmp_path, name):
    (tmp_path / name).write_bytes(b"# nothing of the kind\n" * 50)
    with pytest.raises(ValueError, match=r"a\.\w+.* cannot be read: \S") as caught:
        read_volume(tmp_path / name)
    assert "\n" not in str(caught.value)
