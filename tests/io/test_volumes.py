"""Volumes in files: round trips, what other programs read, and clear refusals."""

import gzip

import nibabel as nib
import numpy as np
import pytest
import SimpleITK
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.io.grids import check_same_grid, check_same_space, on_grid_of
from bayesreg.io.volumes import load_image, load_labels, load_mask, load_whole_numbers, save_image
from bayesreg.types import InputError
from tests.test_image import AFFINES, affine_of

SHAPE = (5, 6, 4)
RIGID = {name: affine for name, affine in AFFINES.items() if name != "sheared"}
TABLE = {"csf": 1, "gm": (2, 8), "wm": [3]}


def some_image(affine=None, dtype=float):
    voxels = np.random.default_rng(0).integers(0, 200, SHAPE).astype(dtype)
    return Image(voxels, affine_of() if affine is None else affine)


def write(path, voxels, affine=None, **kwargs):
    nib.save(nib.Nifti1Image(voxels, np.eye(4) if affine is None else affine, **kwargs), path)
    return path


class TestRoundTrip:
    @pytest.mark.parametrize("affine", AFFINES.values(), ids=AFFINES.keys())
    @pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
    def test_keeps_voxels_and_orientation(self, tmp_path, affine, suffix):
        image = some_image(affine)
        save_image(image, tmp_path / f"image{suffix}")
        loaded = load_image(tmp_path / f"image{suffix}")
        np.testing.assert_array_equal(loaded.voxels, image.voxels)
        np.testing.assert_allclose(loaded.affine, affine, rtol=1e-6, atol=1e-5)

    @pytest.mark.parametrize(
        ("dtype", "stored"),
        [("f8", "f4"), ("f4", "f4"), ("i2", "i2"), ("u1", "u1"), ("i8", "i4"), ("?", "u1")],
    )
    def test_number_types(self, tmp_path, dtype, stored):
        image = some_image(dtype=dtype)
        save_image(image, tmp_path / "image.nii.gz")
        loaded = load_image(tmp_path / "image.nii.gz").voxels
        assert loaded.dtype == np.dtype(stored)
        np.testing.assert_array_equal(loaded, image.voxels)

    def test_integers_too_large_for_32_bits_are_kept(self, tmp_path):
        save_image(Image(np.full(SHAPE, 2**40), np.eye(4)), tmp_path / "image.nii")
        np.testing.assert_array_equal(load_image(tmp_path / "image.nii").voxels, 2**40)

    def test_a_failing_write_leaves_the_old_file(self, tmp_path, monkeypatch):
        save_image(some_image(), tmp_path / "image.nii.gz")
        before = (tmp_path / "image.nii.gz").read_bytes()

        def fail(image, file):
            file.write(b"half")
            raise OSError("disk full")

        monkeypatch.setattr(nib.Nifti1Image, "to_stream", fail)
        with pytest.raises(OSError, match="disk full"):
            save_image(some_image(np.eye(4)), tmp_path / "image.nii.gz")
        assert (tmp_path / "image.nii.gz").read_bytes() == before
        assert [path.name for path in tmp_path.iterdir()] == ["image.nii.gz"]

    def test_refuses_other_names(self, tmp_path):
        with pytest.raises(ValueError, match=r"must end in \.nii or \.nii\.gz"):
            save_image(some_image(), tmp_path / "image.png")

    def test_refuses_a_folder_that_is_not_there(self, tmp_path):
        with pytest.raises(ValueError, match=r"there is no folder .*missing"):
            save_image(some_image(), tmp_path / "missing" / "image.nii")


@pytest.mark.parametrize("affine", RIGID.values(), ids=RIGID.keys())
def test_simpleitk_sees_the_voxels_at_the_same_places(tmp_path, affine):
    image = some_image(affine)
    save_image(image, tmp_path / "image.nii.gz")
    itk_image = SimpleITK.ReadImage(str(tmp_path / "image.nii.gz"))
    index = (3, 1, 2)
    ras = np.array(itk_image.TransformIndexToPhysicalPoint(index)) * (-1, -1, 1)
    np.testing.assert_allclose(ras, image.voxel_to_world(np.array(index, float)), atol=1e-4)
    assert itk_image[index] == image.voxels[index]


class TestLoadImage:
    def test_drops_trailing_axes_of_length_one(self, tmp_path):
        path = write(tmp_path / "a.nii", np.zeros((*SHAPE, 1, 1), np.float32))
        assert load_image(path).shape == SHAPE

    def test_applies_the_scale_of_the_file(self, tmp_path):
        source = nib.Nifti1Image(np.arange(8, dtype=np.int16).reshape(2, 2, 2), np.eye(4))
        source.header.set_slope_inter(0.5, 10)
        nib.save(source, tmp_path / "a.nii")
        np.testing.assert_allclose(load_image(tmp_path / "a.nii").voxels.ravel(), 10 + 0.5 * np.arange(8))

    def test_reads_the_qform_where_there_is_no_sform(self, tmp_path):
        source = nib.Nifti1Image(np.zeros(SHAPE, np.float32), None)
        source.set_qform(RIGID["oblique left-handed"], code=1)
        nib.save(source, tmp_path / "a.nii")
        np.testing.assert_allclose(load_image(tmp_path / "a.nii").affine, RIGID["oblique left-handed"], atol=1e-5)

    def test_turns_foreign_byte_order_around(self, tmp_path):
        path = write(tmp_path / "a.nii", np.arange(8, dtype=">i2").reshape(2, 2, 2))
        voxels = load_image(path).voxels
        assert voxels.dtype.isnative
        np.testing.assert_array_equal(voxels.ravel(), np.arange(8))

    def test_warns_of_a_missing_orientation(self, tmp_path, caplog):
        path = write(tmp_path / "a.nii", np.zeros(SHAPE, np.float32), affine=None)
        source = nib.load(path)
        bare = nib.Nifti1Image(np.asarray(source.dataobj), None)
        nib.save(bare, tmp_path / "bare.nii")
        load_image(tmp_path / "bare.nii")
        assert "says nothing of its orientation" in caplog.text

    def test_refuses_a_missing_file(self, tmp_path):
        with pytest.raises(ValueError, match=r"missing\.nii: there is no such file"):
            load_image(tmp_path / "missing.nii")

    def test_refuses_what_is_no_image(self, tmp_path):
        (tmp_path / "a.nii").write_text("not an image")
        with pytest.raises(ValueError, match=r"a\.nii cannot be read"):
            load_image(tmp_path / "a.nii")

    def test_refuses_a_surface(self, tmp_path):
        nib.save(nib.gifti.GiftiImage(), tmp_path / "a.gii")
        with pytest.raises(ValueError, match="holds no image on a grid, but GiftiImage"):
            load_image(tmp_path / "a.gii")

    def test_refuses_a_file_cut_short(self, tmp_path):
        path = write(tmp_path / "a.nii.gz", np.random.default_rng(0).normal(size=(9, 9, 9)))
        path.write_bytes(path.read_bytes()[:-3000])
        with pytest.raises(ValueError, match=r"a\.nii\.gz.*(cut short|cannot be read)"):
            load_image(path)

    def test_refuses_damaged_compression(self, tmp_path):
        path = write(tmp_path / "a.nii", np.random.default_rng(0).integers(0, 9, (20, 20, 20)).astype(float))
        packed = bytearray(gzip.compress(path.read_bytes()))
        packed[1000:1100] = bytes(100)
        (tmp_path / "b.nii.gz").write_bytes(packed)
        with pytest.raises(ValueError, match=r"b\.nii\.gz.*(cut short|cannot be read)"):
            load_image(tmp_path / "b.nii.gz")

    @pytest.mark.parametrize("shape", [(4, 5), (*SHAPE, 2), (*SHAPE, 1, 3)])
    def test_refuses_other_than_three_axes(self, tmp_path, shape):
        path = write(tmp_path / "a.nii", np.zeros(shape, np.float32))
        with pytest.raises(ValueError, match=r"a\.nii: expected a 3D image, got shape"):
            load_image(path)

    def test_refuses_colours(self, tmp_path):
        path = write(tmp_path / "a.nii", np.zeros(SHAPE, [("R", "u1"), ("G", "u1"), ("B", "u1")]))
        with pytest.raises(ValueError, match="one real number per voxel"):
            load_image(path)

    def test_refuses_a_singular_affine(self, tmp_path):
        source = nib.Nifti1Image(np.zeros(SHAPE, np.float32), np.eye(4))
        source.header["srow_z"] = 0
        source.header["sform_code"] = 1
        raw = nib.Nifti1Image(np.zeros(SHAPE, np.float32), None, source.header)
        nib.save(raw, tmp_path / "a.nii")
        with pytest.raises(ValueError, match=r"a\.nii: the affine is singular"):
            load_image(tmp_path / "a.nii")

    def test_refuses_nan(self, tmp_path):
        voxels = np.zeros(SHAPE, np.float32)
        voxels[1, 2, 3] = np.nan
        with pytest.raises(ValueError, match=r"a\.nii: 1 voxels are NaN"):
            load_image(write(tmp_path / "a.nii", voxels))


class TestLoadLabels:
    voxels = np.array([0, 1, 2, 3, 8, 9, 0, 2], np.uint8).reshape(2, 2, 2)

    def test_maps_values_to_tissues(self, tmp_path):
        tissue = load_labels(write(tmp_path / "a.nii", self.voxels), TABLE)
        np.testing.assert_array_equal(tissue.voxels.ravel(), [0, 1, 2, 3, 2, 0, 0, 2])
        assert tissue.voxels.dtype == np.int8

    def test_reads_whole_numbers_stored_as_floats(self, tmp_path):
        tissue = load_labels(write(tmp_path / "a.nii", self.voxels.astype(np.float32)), TABLE)
        np.testing.assert_array_equal(tissue.voxels.ravel(), [0, 1, 2, 3, 2, 0, 0, 2])

    def test_names_absent_tissues_and_the_labels_present(self, tmp_path):
        path = write(tmp_path / "a.nii", self.voxels)
        with pytest.raises(ValueError, match=r"no label of wm \(41, 42\); it holds 0, 1, 2, 3, 8, 9"):
            load_labels(path, {"csf": 1, "gm": (2, 7), "wm": (41, 42)})

    def test_a_table_may_serve_a_cohort(self, tmp_path):
        tissue = load_labels(write(tmp_path / "a.nii", self.voxels), TABLE | {"gm": (2, 8, 77)})
        np.testing.assert_array_equal(tissue.voxels.ravel(), [0, 1, 2, 3, 2, 0, 0, 2])

    @pytest.mark.parametrize("away", [7e-10, 0.02])
    def test_rounds_what_is_nearly_whole_and_says_so(self, tmp_path, caplog, away):
        tissue = load_labels(write(tmp_path / "a.nii", self.voxels + away), TABLE)
        np.testing.assert_array_equal(tissue.voxels.ravel(), [0, 1, 2, 3, 2, 0, 0, 2])
        assert "they are rounded" in caplog.text

    def test_what_is_not_listed_is_refused_or_named_background(self, tmp_path):
        path = write(tmp_path / "a.nii", self.voxels, np.diag([10.0, 10, 10, 1]))
        with pytest.raises(ValueError, match=r"does not list: 9 \(1 ml\).*list it under background"):
            load_labels(path, TABLE, unlisted="refused")
        tissue = load_labels(path, TABLE | {"background": 9}, unlisted="refused")
        np.testing.assert_array_equal(tissue.voxels.ravel(), [0, 1, 2, 3, 2, 0, 0, 2])

    def test_a_long_list_is_cut(self, tmp_path):
        path = write(tmp_path / "a.nii", np.arange(1000, dtype=np.int16).reshape(10, 10, 10))
        with pytest.raises(ValueError, match="does not list") as caught:
            load_labels(path, TABLE, unlisted="refused")
        assert len(str(caught.value)) < 1000

    def test_refuses_labels_of_more_than_32_bits(self, tmp_path):
        with pytest.raises(ValueError, match="at most 32 bits"):
            load_labels(write(tmp_path / "a.nii", np.full((2, 2, 2), 2**63 + 5, np.uint64), dtype=np.uint64), TABLE)

    def test_refuses_a_value_with_two_meanings(self, tmp_path):
        with pytest.raises(ValueError, match="label 2 stands for both gm and wm"):
            load_labels(write(tmp_path / "a.nii", self.voxels), {"gm": 2, "wm": (2, 3)})

    def test_refuses_a_tissue_without_values(self, tmp_path):
        with pytest.raises(ValueError, match="no value for wm"):
            load_labels(write(tmp_path / "a.nii", self.voxels), {"gm": 2, "wm": ()})

    def test_refuses_intensities(self, tmp_path):
        with pytest.raises(ValueError, match="not integers"):
            load_labels(write(tmp_path / "a.nii", np.linspace(0, 1, 8).reshape(2, 2, 2)), TABLE)


class TestLoadMask:
    ball = np.linalg.norm(np.indices((20, 20, 20)) - 9.5, axis=0) < 6

    @pytest.mark.parametrize("values", [(0, 1), (0, 255), (1, 2), (-3.5, 1.5)])
    def test_of_two_values_the_greater_is_inside(self, tmp_path, values):
        mask = load_mask(write(tmp_path / "a.nii", np.where(self.ball, values[1], values[0]).astype(np.float32)))
        np.testing.assert_array_equal(mask.voxels, self.ball)
        assert mask.voxels.dtype == np.uint8

    @pytest.mark.parametrize("order", [1, 3])
    def test_probabilities_are_cut_at_a_half(self, tmp_path, caplog, order):
        """Smoothed, or resampled by a spline, which overshoots."""
        soft = ndimage.shift(self.ball.astype(float), 0.3, order=order)
        soft = ndimage.gaussian_filter(soft, 0.7) if order == 1 else soft
        mask = load_mask(write(tmp_path / "a.nii", soft.astype(np.float32)))
        assert mask.voxels.sum() == pytest.approx(self.ball.sum(), rel=0.05)
        assert "at least 0.5 is inside" in caplog.text

    def test_255_that_was_stored_as_signed_is_not_the_outside(self, tmp_path):
        with pytest.raises(ValueError, match=r"the values -1 and 0; expected the greater above zero"):
            load_mask(write(tmp_path / "a.nii", -self.ball.astype(np.int16)))

    @pytest.mark.parametrize("voxels", [np.arange(8.0), np.linspace(0, 0.4, 8), np.linspace(0, 100, 8)])
    def test_anything_else_is_refused(self, tmp_path, voxels):
        with pytest.raises(ValueError, match="expected two values, or probabilities"):
            load_mask(write(tmp_path / "a.nii", voxels.reshape(2, 2, 2)))


class TestSameGrid:
    def test_accepts_the_same_grid(self):
        check_same_grid(some_image(), some_image(dtype="i2"))

    def test_refuses_another_shape(self):
        with pytest.raises(ValueError, match=r"the fixed and the label image must share one grid.*\(2, 2, 2\)"):
            check_same_grid(some_image(), Image(np.zeros((2, 2, 2)), np.eye(4)), ("fixed", "label"))

    def test_refuses_another_affine(self):
        with pytest.raises(ValueError, match=r"corners up to .* mm apart"):
            check_same_grid(some_image(), some_image(affine_of(origin=(-20.0, 7.5, 3.0))))


class TestSameSpace:
    def test_accepts_images_that_overlap(self):
        check_same_space(some_image(), some_image(AFFINES["oblique"]))

    def test_refuses_images_apart(self):
        with pytest.raises(ValueError, match=r"the moving image covers 0% of the fixed one.*\[-18.0, 9.5, 4.5\]"):
            check_same_space(some_image(), some_image(affine_of(origin=(500.0, 0, 0))), ("fixed", "moving"))


class TestOnGridOf:
    def test_another_order_of_axes_is_the_same_voxels(self, caplog):
        image = some_image()
        turned = Image(image.voxels.transpose(2, 0, 1)[::-1], image.affine @ TURNED)
        np.testing.assert_array_equal(on_grid_of(image, turned).voxels, image.voxels)
        assert not caplog.records

    def test_takes_the_nearest_voxel_and_says_so(self, caplog):
        image = some_image()
        fine = Image(np.kron(image.voxels, np.ones((3, 3, 3))), image.affine @ THIRDS)
        np.testing.assert_array_equal(on_grid_of(image, fine, ("fixed", "label")).voxels, image.voxels)
        assert "the label image lies on another grid than the fixed one" in caplog.text

    def test_says_what_falls_off_a_grid_of_whole_voxels(self, caplog):
        image = Image(np.ones((10, 10, 10), np.uint8), np.diag([10.0, 10, 10, 1]))
        resampled = on_grid_of(Image(np.zeros((10, 10, 4)), image.affine), image)
        assert resampled.voxels.all()
        assert "of 1000 ml that are not zero 400 remain" in caplog.text

    def test_half_a_voxel_at_the_border_is_on_the_grid(self):
        image = Image(np.ones((10, 10, 10), np.uint8), np.eye(4))
        shifted = np.eye(4)
        shifted[:3, 3] = -0.45, 0.45, 0.0
        assert on_grid_of(Image(np.zeros((10, 10, 10)), shifted), image).voxels.all()

    def test_refuses_images_apart(self):
        with pytest.raises(ValueError, match="covers 0%"):
            on_grid_of(some_image(), some_image(affine_of(origin=(500.0, 0, 0))))


# Voxels of (z reversed, x, y), and of thirds, as voxels of the image.
TURNED = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, SHAPE[2] - 1], [0, 0, 0, 1.0]])
THIRDS = np.array([[1 / 3, 0, 0, -1 / 3], [0, 1 / 3, 0, -1 / 3], [0, 0, 1 / 3, -1 / 3], [0, 0, 0, 1.0]])


class TestProbabilities:
    def test_the_most_probable_tissue_is_the_label(self, tmp_path, caplog):
        shares = np.zeros((4, 4, 4, 3), np.float32)
        shares[0, ..., 0], shares[1, ..., 1], shares[2, ..., 2] = 0.9, 0.6, 0.55
        shares[1, ..., 2] = 0.4
        path = write(tmp_path / "tissues.nii.gz", shares)
        labels = load_whole_numbers(path)
        np.testing.assert_array_equal(labels.voxels[:, 0, 0], [1, 2, 3, 0])
        assert "probabilities of 3 tissues" in caplog.text
        tissue = load_labels(path, {"gm": 1, "wm": 2, "csf": 3})
        np.testing.assert_array_equal(tissue.voxels[:, 0, 0], [1, 2, 3, 0])

    def test_several_volumes_of_something_else_are_refused(self, tmp_path):
        path = write(tmp_path / "bold.nii.gz", np.full((4, 4, 4, 5), 800.0))
        with pytest.raises(InputError, match="5 volumes, which are no probabilities"):
            load_whole_numbers(path)


def test_an_image_that_zstandard_compressed_is_read(tmp_path):
    image = some_image()
    write(tmp_path / "image.nii.zst", np.asarray(image.voxels), image.affine)
    np.testing.assert_array_equal(load_image(tmp_path / "image.nii.zst").voxels, image.voxels)
