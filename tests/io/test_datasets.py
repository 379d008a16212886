"""Anatomies: MNI152 from nilearn's wheel, BrainWeb where its files are, and one's own files."""

import os

import nibabel as nib
import numpy as np
import pytest
from scipy import ndimage

from bayesreg.io.datasets import brainweb, check_same_grid, from_files, mni152, without_labels

needs_brainweb = pytest.mark.skipif(
    not os.environ.get("BAYESREG_DATA"), reason="needs the BrainWeb files, in a folder that BAYESREG_DATA names"
)


@pytest.fixture(scope="module")
def mni():
    return mni152()


@pytest.fixture
def files(tmp_path):
    labels = np.zeros((6, 6, 6), np.int16)
    labels[1:5, 1:5, 1:5] = 12
    labels[2:4, 2:4, 2:4] = 13
    labels[3, 3, 3] = 11
    paths = {name: tmp_path / f"{name}.nii" for name in ("t1", "labels", "inside")}
    for name, voxels in {"t1": labels * 2.5, "labels": labels, "inside": (labels > 0) * 255.0}.items():
        nib.save(nib.Nifti1Image(voxels, np.diag([2.0, 2.0, 2.0, 1.0])), paths[name])
    return paths


OWN_TABLE = {"csf": 11, "gm": 12, "wm": 13}


def check_anatomy(anatomy):
    check_same_grid(anatomy.image, anatomy.tissue)
    check_same_grid(anatomy.image, anatomy.intracranial)
    assert set(np.unique(anatomy.tissue.voxels)) == {0, 1, 2, 3}
    assert set(np.unique(anatomy.intracranial.voxels)) == {0, 1}
    assert (anatomy.intracranial.voxels[anatomy.tissue.voxels > 0] == 1).all()


def mean_intensities(anatomy):
    return [anatomy.image.voxels[anatomy.tissue.voxels == tissue].mean() for tissue in (1, 2, 3)]


class TestMni152:
    def test_is_a_complete_anatomy(self, mni):
        check_anatomy(mni)

    def test_tissues_have_the_contrast_of_t1(self, mni):
        csf, gm, wm = mean_intensities(mni)
        assert 0.3 < csf < 0.45 < gm < 0.75 < wm < 1

    def test_volumes_are_those_of_a_brain(self, mni):
        litres = np.bincount(mni.tissue.voxels.ravel())[1:] * mni.tissue.voxel_volume / 1e6
        np.testing.assert_allclose(litres, (0.156, 1.091, 0.636), atol=0.02)

    def test_ventricles_are_csf_on_both_sides(self, mni):
        points = np.array([[-14.0, -30, 18], [14.0, -30, 18], [-25.0, -20, 28], [25.0, -20, 28]])
        index = np.rint(mni.tissue.world_to_voxel(points)).astype(int)
        np.testing.assert_array_equal(mni.tissue.voxels[tuple(index.T)], [1, 1, 3, 3])


@needs_brainweb
class TestBrainWeb:
    def test_is_a_complete_anatomy(self):
        anatomy = brainweb()
        check_anatomy(anatomy)
        np.testing.assert_array_equal(anatomy.image.voxel_to_world(np.zeros(3)), (-90, -126, -72))
        assert (anatomy.intracranial.voxels != 0).sum() == 1_955_020
        csf, gm, wm = mean_intensities(anatomy)
        assert csf < 60 < gm < 120 < wm

    def test_refuses_a_t1_on_another_grid(self, files):
        with pytest.raises(ValueError, match="the T1 and the label image must share one grid"):
            brainweb(t1_path=files["t1"])


def test_brainweb_says_how_to_find_its_files(monkeypatch):
    monkeypatch.delenv("BAYESREG_DATA", raising=False)
    with pytest.raises(ValueError, match="environment variable BAYESREG_DATA"):
        brainweb()


def test_brainweb_says_which_file_is_missing(monkeypatch, tmp_path):
    monkeypatch.setenv("BAYESREG_DATA", str(tmp_path))
    with pytest.raises(ValueError, match=r"colin27_t1_1mm_unedited\.nii\.gz: there is no such file"):
        brainweb()


class TestFromFiles:
    def test_reads_one_s_own(self, files):
        anatomy = from_files(files["t1"], files["labels"], OWN_TABLE, files["inside"])
        check_anatomy(anatomy)
        assert anatomy.tissue.voxels[3, 3, 3] == 1
        assert anatomy.tissue.voxels[1, 1, 1] == 2
        assert anatomy.tissue.voxels[2, 2, 2] == 3

    def test_goes_without_an_intracranial_mask(self, files):
        assert from_files(files["t1"], files["labels"], OWN_TABLE).intracranial is None

    def test_takes_any_tissues_in_the_order_of_the_table(self, files):
        anatomy = from_files(files["t1"], files["labels"], {"tumour": 13, "gm": 12, "background": 11})
        assert anatomy.names == ("tumour", "gm")
        assert anatomy.tissue.voxels[2, 2, 2] == 1

    def test_refuses_a_label_that_is_not_listed(self, files):
        with pytest.raises(ValueError, match=r"does not list: 11 \(0.008 ml\)"):
            from_files(files["t1"], files["labels"], {"gm": 12, "wm": 13})

    def test_a_table_may_hold_tissues_that_are_not_there(self, files, caplog):
        anatomy = from_files(files["t1"], files["labels"], {"oedema": 7, "csf": 11, "cyst": [8, 9], "gm": [12, 13]})
        assert anatomy.names == ("csf", "gm")
        assert anatomy.tissue.voxels[3, 3, 3] == 1
        assert anatomy.tissue.voxels[1, 1, 1] == 2
        assert "no label of oedema and cyst" in caplog.text
        with pytest.raises(ValueError, match="holds no label of oedema"):
            from_files(files["t1"], files["labels"], {"oedema": 7, "background": [11, 12, 13]})

    def test_the_rest_goes_on_beyond_the_grid_of_the_labels(self, files, tmp_path):
        """Labels that were cropped to the tumour, on a background that is no part of the organ."""
        tumour = np.full((2, 2, 3), 5, np.int16)
        tumour[0, 0, 0], tumour[1, 1, 2] = 0, 9
        affine = np.diag([2.0, 2.0, 2.0, 1.0])
        affine[:3, 3] = 4.0
        nib.save(nib.Nifti1Image(tumour, affine), tmp_path / "tumour.nii")
        table = {"brain": 0, "tumour": 5, "background": 9}
        tissue = np.asarray(from_files(files["t1"], tmp_path / "tumour.nii", table, files["inside"]).tissue.voxels)
        assert (tissue[2:4, 2:4, 2:5] == np.where(tumour == 5, 2, np.where(tumour == 9, 0, 1))).all()
        assert tissue[1, 1, 1] == 1
        assert tissue[0, 0, 0] == 0
        nib.save(nib.Nifti1Image(np.full((2, 2, 3), 5, np.int16), affine), tmp_path / "full.nii")
        dataset = from_files(files["t1"], tmp_path / "full.nii", {"brain": 0, "tumour": 5}, files["inside"])
        assert dataset.names == ("brain", "tumour")
        assert dataset.tissue.voxels[1, 1, 1] == 1

    def test_zero_is_the_rest_of_the_mask(self, files, tmp_path):
        """A mask on a finer grid: what has no label is the organ within it and nothing beyond."""
        inside = np.zeros((12, 12, 12), np.uint8)
        inside[:10] = 1
        nib.save(nib.Nifti1Image(inside, np.diag([1.0, 1, 1, 1])), tmp_path / "mask.nii")
        table = {"brain": 0, "oedema": 12, "tumour_core": [11, 13]}
        anatomy = from_files(files["t1"], files["labels"], table, tmp_path / "mask.nii")
        tissue = np.asarray(anatomy.tissue.voxels)
        assert anatomy.names == ("brain", "oedema", "tumour_core")
        assert (tissue[0] == 1).all()
        assert (tissue[5] == 0).all()
        assert tissue[1, 1, 1] == 2
        assert tissue[3, 3, 3] == tissue[2, 2, 2] == 3
        with pytest.raises(ValueError, match="nothing says where it ends"):
            from_files(files["t1"], files["labels"], table)

    def test_takes_labels_on_another_grid(self, files, tmp_path):
        nib.save(nib.Nifti1Image(np.zeros((12, 12, 12)), np.diag([1.0, 1, 1, 1])), tmp_path / "fine.nii")
        anatomy = from_files(tmp_path / "fine.nii", files["labels"], OWN_TABLE, files["inside"])
        check_same_grid(anatomy.image, anatomy.tissue)
        check_same_grid(anatomy.image, anatomy.intracranial)
        assert set(np.unique(anatomy.tissue.voxels)) == {0, 1, 2, 3}

    @pytest.mark.parametrize("suffix", ["nii", "nii.gz", "NII", "img"])
    def test_tells_of_a_grid_that_is_one_by_the_other_form(self, files, tmp_path, suffix):
        source = (nib.Nifti1Pair if suffix == "img" else nib.Nifti1Image)(np.zeros((6, 6, 6)), None)
        source.set_sform(np.diag([2.2, 2.0, 2.0, 1.0]), 4)
        source.set_qform(np.diag([2.0, 2.0, 2.0, 1.0]), 1)
        source.to_filename(tmp_path / f"t1.{suffix.lower()}")
        (tmp_path / f"t1.{suffix.lower()}").rename(tmp_path / f"t1.{suffix}")
        with pytest.raises(ValueError, match=rf"share one grid by the q-form of .*t1\.{suffix}, but not by its s-form"):
            from_files(tmp_path / f"t1.{suffix}", files["labels"], OWN_TABLE)

    def test_refuses_a_tissue_that_the_image_does_not_reach(self, files, tmp_path):
        nib.save(nib.Nifti1Image(np.zeros((6, 6, 3)), np.diag([2.0, 2.0, 2.0, 1.0])), tmp_path / "part.nii")
        with pytest.raises(ValueError, match=r"no voxel of csf in .*labels\.nii lies on the grid of .*part\.nii"):
            from_files(tmp_path / "part.nii", files["labels"], OWN_TABLE)


def head(affine):
    """A bright ball with a dark hole, on a dark noisy ground, and where it is."""
    shape = (30, 32, 28)
    x = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) - np.array(shape) / 2
    radius = np.linalg.norm(x, axis=-1)
    rng = np.random.default_rng(0)
    voxels = np.where((radius < 11) & (radius > 3), 100.0, 0.0) + 5 * rng.normal(size=shape)
    voxels[1:3, 1:3, 1:3] = 100.0
    return nib.Nifti1Image(voxels.astype(np.float32), affine), radius < 11


class TestWithoutLabels:
    def test_a_mask_is_the_organ_and_bounds_it(self, files):
        dataset = without_labels(files["t1"], files["inside"])
        assert dataset.names == ("organ",)
        np.testing.assert_array_equal(dataset.tissue.voxels, dataset.intracranial.voxels)
        assert dataset.tissue.voxels.sum() == 64

    def test_without_one_the_organ_is_what_stands_out_filled(self, tmp_path, caplog):
        image, ball = head(np.diag([2.0, 2.0, 2.0, 1.0]))
        nib.save(image, tmp_path / "head.nii")
        dataset = without_labels(tmp_path / "head.nii")
        assert dataset.intracranial is None
        assert (np.asarray(dataset.tissue.voxels) != ball).sum() < 0.03 * ball.sum()
        assert "Otsu" in caplog.text
        assert f"{np.count_nonzero(dataset.tissue.voxels) * 8 / 1000:.4g} ml" in caplog.text


def test_a_sheared_image_is_laid_on_axes_at_right_angles(tmp_path, caplog):
    """A gantry tilt: the ball stays where it is in the world, and results are written on a grid that ITK opens."""
    sheared = np.array([[2.0, 0, 0, 5], [0, 2, 0.6, -3], [0, 0, 2, 1], [0, 0, 0, 1]])
    image, ball = head(sheared)
    image = nib.Nifti1Image(ndimage.gaussian_filter(np.asarray(image.dataobj), 1.5), sheared)
    nib.save(image, tmp_path / "head.nii")
    nib.save(nib.Nifti1Image(ball.astype(np.uint8), sheared), tmp_path / "ball.nii")
    dataset = from_files(tmp_path / "head.nii", tmp_path / "ball.nii", {"organ": 1})
    assert dataset.image.is_orthogonal
    assert "not at right angles" in caplog.text
    centre = nib.affines.apply_affine(sheared, np.argwhere(ball).mean(axis=0))
    label_centre = dataset.tissue.voxel_to_world(np.argwhere(np.asarray(dataset.tissue.voxels)).mean(axis=0))
    np.testing.assert_allclose(label_centre, centre, atol=0.1)
    points = nib.affines.apply_affine(sheared, np.argwhere(ball)[::50])
    intensities = np.asarray(image.dataobj)[tuple(np.argwhere(ball)[::50].T)]
    assert np.corrcoef(intensities, np.asarray(dataset.image.interpolate(points, "cubic")))[0, 1] > 0.98


def test_a_straight_image_stays_as_it_is(files):
    dataset = from_files(files["t1"], files["labels"], OWN_TABLE)
    np.testing.assert_array_equal(dataset.image.voxels, np.asarray(nib.load(files["t1"]).dataobj))
