"""Files as users have them: other formats, and headers whose two forms, units or offsets are at odds."""

import gzip
import locale
import struct

import nibabel as nib
import numpy as np
import pytest
import SimpleITK

from bayesreg.image import Image
from bayesreg.io.grids import corners_apart
from bayesreg.io.readers import read_grid, read_volume
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


SLICES = np.diag([2.0, 2.0, 3.0, 1.0])


def dicom(folder, places=(0.0, 3.0, 6.0, 9.0), series="1.2.3.4", tilt=0.0):
    """A series of slices at these heights, mm, in LPS; the names of the files and their numbers are in another order.

    With a tilt each lies so much further along y, mm per mm.
    """
    folder.mkdir(exist_ok=True)
    # GDCM's writer sets the locale of the process to C, which changes how Python reads text.
    before = locale.setlocale(locale.LC_ALL)
    image = SimpleITK.Cast(itk_image(affine=SLICES), SimpleITK.sitkInt16)
    writer = SimpleITK.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for number, height in enumerate(places):
        slice_image = image[:, :, number % SHAPE[2]]
        tags = {
            "0008|0060": "MR",
            "0020|000e": series,
            "0008|0018": f"{series}.{number}",
            "0020|0032": f"0\\{tilt * height}\\{height}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0020|0013": str((5 * number) % 7),
            "0018|0050": "3",
        }
        for tag, value in tags.items():
            slice_image.SetMetaData(tag, value)
        writer.SetFileName(str(folder / f"{(3 * number) % 7}_{number}.dcm"))
        writer.Execute(slice_image)
    locale.setlocale(locale.LC_ALL, before)
    return folder


def test_a_dicom_folder(tmp_path):
    """LPS axes run to the left and backwards: in RAS the first voxel is at 0 and x and y fall."""
    folder, before = dicom(tmp_path / "series"), locale.setlocale(locale.LC_ALL)
    volume = read_volume(folder)
    assert locale.setlocale(locale.LC_ALL) == before
    np.testing.assert_array_equal(volume.voxels, VOXELS)
    np.testing.assert_allclose(volume.affine, np.diag([-2.0, -2.0, 3.0, 1.0]), atol=1e-6)


def test_a_gantry_tilt_is_a_shear(tmp_path):
    volume = read_volume(dicom(tmp_path / "series", tilt=0.4))
    np.testing.assert_array_equal(volume.voxels, VOXELS)
    np.testing.assert_allclose(volume.affine[:3, 2], (0, -1.2, 3), atol=1e-6)


@pytest.mark.parametrize(
    "places", [(0.0, 3.0, 9.0), (0.0, 0.0, 3.0, 3.0, 6.0, 6.0), (0.0, 3.0, 6.0, 20.0)], ids=["gap", "twice", "uneven"]
)
def test_slices_that_are_not_evenly_spaced_are_refused(tmp_path, places):
    with pytest.raises(ValueError, match="are not evenly spaced: one lies"):
        read_volume(dicom(tmp_path / "series", places))


def test_a_slice_that_cannot_be_read_is_named(tmp_path):
    folder = dicom(tmp_path / "series")
    broken = sorted(folder.iterdir())[-1]
    broken.write_bytes(broken.read_bytes()[:140])
    with pytest.raises(ValueError, match=rf"{broken.name} cannot be read as part of"):
        read_volume(folder)


def test_nor_is_one_without_an_ending_left_out(tmp_path):
    folder = dicom(tmp_path / "series")
    for path in sorted(folder.iterdir()):
        path.rename(path.with_suffix(""))
    np.testing.assert_array_equal(read_volume(folder).voxels, VOXELS)
    last = max(folder.iterdir(), key=lambda path: path.name.split("_")[1])
    last.write_bytes(last.read_bytes()[:140])
    with pytest.raises(ValueError, match=rf"{last.name} cannot be read as part of"):
        read_volume(folder)


def test_one_slice_is_no_volume(tmp_path):
    folder = dicom(tmp_path / "series")
    with pytest.raises(ValueError, match="is one slice; give the folder"):
        read_volume(next(folder.iterdir()))


def test_a_folder_without_one_series_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds 0 DICOM series; expected one"):
        read_volume(tmp_path)
    dicom(tmp_path / "series")
    (second_file,) = dicom(tmp_path / "other", (0.0,), "1.2.3.5").iterdir()
    second_file.rename(tmp_path / "series" / "other.dcm")
    with pytest.raises(ValueError, match=r"holds 2 DICOM series: 1\.2\.3"):
        read_volume(tmp_path / "series")


def test_forms_at_odds_are_told_and_the_s_form_is_taken(tmp_path, caplog):
    source = nib.Nifti1Image(VOXELS, None)
    sform = np.diag([1.05, 1.02, 1.08, 1.0]) @ AFFINE
    source.set_sform(sform, 4)
    source.set_qform(AFFINE, 1)
    nib.save(source, tmp_path / "a.nii")
    volume = read_volume(tmp_path / "a.nii")
    check(volume, sform)
    np.testing.assert_allclose(read_grid(tmp_path / "a.nii").qform, AFFINE, atol=1e-4)
    assert f"corners up to {corners_apart(sform, AFFINE, SHAPE):.3g} mm apart; the s-form is taken" in caplog.text


def test_forms_that_agree_are_not_mentioned(tmp_path, caplog):
    read_volume(nifti(tmp_path / "a.nii"))
    assert read_grid(tmp_path / "a.nii").qform is None
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
    assert volume.affine[0, 0] == -2
    assert "does not tell left from right; its first axis is taken to run to the left" in caplog.text


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
    ("change", "message"),
    [
        (unit_quaternion, ""),
        (zero_sform, "its q-form is taken"),
        (trailing_zero, ""),
    ],
)
def test_headers_that_simpleitk_reads_are_read_as_it_does(tmp_path, caplog, change, message):
    path = nifti(tmp_path / "a.nii", change)
    reference = SimpleITK.ReadImage(str(path))
    volume = load_image(path)
    np.testing.assert_array_equal(volume.voxels, VOXELS)
    for index in ((0, 0, 0), (4, 0, 1), (2, 5, 3)):
        ras = np.array(reference.TransformIndexToPhysicalPoint(index)) * (-1, -1, 1)
        np.testing.assert_allclose(volume.voxel_to_world(np.array(index, float)), ras, atol=1e-3)
    assert message in caplog.text


@pytest.mark.parametrize("offset", [16, 100, 348, -5])
def test_other_offsets_inside_the_header_are_refused(tmp_path, offset):
    path = nifti(tmp_path / "a.nii", lambda header: header.__setitem__("vox_offset", offset))
    with pytest.raises(ValueError, match=r"a\.nii cannot be read"):
        read_volume(path)


def test_a_short_file_is_no_image_whatever_its_header(tmp_path):
    path = nifti(tmp_path / "a.nii", trailing_zero)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="cut short or damaged"):
        read_volume(path)


@pytest.mark.parametrize("damage", ["a byte", "the checksum"])
def test_damage_that_only_the_checksum_shows(tmp_path, damage):
    noise = np.random.default_rng(1).integers(0, 255, (30, 30, 30), np.uint8)
    nib.save(nib.Nifti1Image(noise, AFFINE), tmp_path / "a.nii")
    packed = bytearray(gzip.compress((tmp_path / "a.nii").read_bytes(), 0))
    packed[len(packed) // 2 if damage == "a byte" else -6] ^= 255
    (tmp_path / "a.nii.gz").write_bytes(bytes(packed))
    with pytest.raises(ValueError, match=r"a\.nii\.gz: the file is cut short or damaged"):
        read_volume(tmp_path / "a.nii.gz")


def test_a_unit_that_nobody_knows_is_mm(tmp_path, caplog):
    check(read_volume(nifti(tmp_path / "a.nii", lambda header: header.__setitem__("xyzt_units", 7))))
    assert "unknown unit; taken to be mm" in caplog.text


def test_an_s_form_that_is_not_finite_gives_way(tmp_path, caplog):
    def change(header):
        header["qform_code"] = 1
        header["srow_x"] = np.nan

    check(read_volume(nifti(tmp_path / "a.nii", change)))
    assert "its q-form is taken" in caplog.text


def test_nrrd_without_a_space_is_told(tmp_path, caplog):
    SimpleITK.WriteImage(itk_image(), str(tmp_path / "a.nrrd"))
    read_volume(tmp_path / "a.nrrd")
    assert not caplog.records
    raw = (tmp_path / "a.nrrd").read_bytes().replace(b"space: left-posterior-superior", b"space dimension: 3")
    (tmp_path / "b.nrrd").write_bytes(raw)
    check(read_volume(tmp_path / "b.nrrd"))
    assert "says nothing of its space" in caplog.text


@pytest.mark.parametrize("name", ["a.PAR", "a.HEAD", "a.nii.zst", "a.mgz", "a.nrrd", "a.mha", "a.nii", "a.mnc"])
def test_what_no_reader_understands_is_one_message(tmp_path, name):
    (tmp_path / name).write_bytes(b"# nothing of the kind\n" * 50)
    with pytest.raises(ValueError, match=r"a\.\w+.* cannot be read: \S") as caught:
        read_volume(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".nrrd", ".mha", ".nii.gz", ".mgz", ""])
def test_a_grid_is_that_of_the_volume(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    if suffix == ".mgz":
        nib.save(nib.MGHImage(VOXELS, AFFINE), path)
    elif suffix:
        SimpleITK.WriteImage(itk_image(), str(path))
    else:
        dicom(path, tilt=0.4)
    grid, volume = read_grid(path), read_volume(path)
    assert grid.shape == volume.voxels.shape
    np.testing.assert_array_equal(grid.affine, volume.affine)
