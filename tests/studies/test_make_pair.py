"""A tiny head: what is written as the truth takes the moving image to the fixed one."""

import json

import nibabel as nib
import numpy as np
import pytest
from scipy import ndimage as ndi

from bayesreg.io.fields import save_displacement
from studies.external.make_pair import CSF, GM, WM, hexahedron, make_pair, slices_about
from studies.external.score import read_truth, score

AFFINE = np.eye(4)
AFFINE[:3, 3] = [-26, -29, -22]
SHAPE = (52, 54, 50)


def near(value):
    return pytest.approx(value, abs=1e-4)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A ball of WM in GM in CSF, with a texture, under the names of BrainWeb and Colin27."""
    folder = tmp_path_factory.mktemp("data")
    index = np.stack(np.meshgrid(*[np.arange(n) for n in SHAPE], indexing="ij"), axis=-1)
    r = np.linalg.norm(index - np.array(SHAPE) / 2, axis=-1)
    labels = np.select([r < 14, r < 20, r < 24], [WM, GM, CSF], 0)
    texture = ndi.gaussian_filter(np.random.default_rng(0).normal(size=SHAPE), 2.0)
    t1 = np.select([r < 14, r < 20, r < 24], [145.0, 109.0, 40.0], 0.0) + 100 * texture
    for array, name in ((t1, "colin27_t1_1mm_unedited"), (labels, "brainweb_crisp_1mm")):
        nib.save(nib.Nifti1Image(array.astype(np.float32), AFFINE), folder / f"{name}.nii.gz")
    return folder


@pytest.mark.parametrize("kind", ["sag", "gravity", "resect"])
def test_the_truth_takes_the_moving_image_to_the_fixed_one(kind, data, tmp_path):
    facts = make_pair(kind, data, tmp_path, seed=3, amplitude=3.0, noise=0.0)
    assert json.loads((tmp_path / "pair.json").read_text()) == facts
    truth = read_truth(tmp_path)
    size = np.linalg.norm(truth.u, axis=-1)[truth.valid]
    assert [facts[name] for name in ("kind", "seed", "max", "mean")] == [kind, 3, near(size.max()), near(size.mean())]
    fixed, moving = (np.asarray(nib.load(tmp_path / f"{name}.nii.gz").dataobj) for name in ("fixed", "moving"))
    index = np.stack(np.meshgrid(*[np.arange(n) for n in SHAPE], indexing="ij"))
    warped = ndi.map_coordinates(moving, index + np.moveaxis(truth.u, -1, 0), order=3)
    inside = ndi.binary_erosion(truth.valid, iterations=4)
    before, after = ((image - fixed)[inside].std() for image in (moving, warped))
    assert after < 0.3 * before

    save_displacement(tmp_path / "truth.nii.gz", truth.u, AFFINE)
    scores = score(tmp_path, tmp_path / "truth.nii.gz")
    assert scores["error"] == [0, 0, 0]
    assert scores["tre"] == pytest.approx([0, 0], abs=0.1)
    assert scores["unregistered_mean"] == pytest.approx(facts["mean"], abs=1e-3)
    assert (scores["cavity_walls"] == [0, 0, 0]) == (kind == "resect")


def test_a_misaligned_shaded_image_of_another_contrast(data, tmp_path):
    facts = make_pair("sag", data, tmp_path, amplitude=0.0, noise=0.0, bias=0.2, contrast="t2", rigid=2.0)
    assert (facts["bias"], facts["contrast"], facts["rigid"]) == (0.2, "t2", 2.0)
    assert facts["residual_sd_at_truth"] is None
    fixed, moving = (nib.load(tmp_path / f"{name}.nii.gz") for name in ("fixed", "moving"))
    truth = read_truth(tmp_path)
    index = np.argwhere(truth.valid)
    displaced = nib.affines.apply_affine(fixed.affine, index) + truth.u[truth.valid]
    # The header alone is misaligned.
    assert nib.affines.apply_affine(moving.affine, index) == pytest.approx(displaced, abs=1e-4)
    gm, wm = (np.asarray(moving.dataobj)[truth.valid & (truth.labels == tissue)].mean() for tissue in (GM, WM))
    assert gm > 1.2 * wm


def test_thick_slices_are_left_handed_and_hold_the_head():
    X = np.stack(np.meshgrid(*[np.arange(n) - 40.0 for n in (80, 90, 100)], indexing="ij"), axis=-1)
    slices = slices_about(X, 3.0)
    assert nib.affines.voxel_sizes(slices.affine) == pytest.approx([1, 1, 3])
    assert np.linalg.det(slices.affine[:3, :3]) < 0
    index = nib.affines.apply_affine(np.linalg.inv(slices.affine), X)
    assert ((index >= 0) & (index <= slices.size - 1)).all()


def test_a_hexahedron_resists_strain_alone():
    lam, mu, edge = 3.0, 2.0, 5.0
    K = hexahedron(lam, mu, edge)
    x = edge * np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    turned = np.cross([0.3, -0.2, 0.5], x)
    assert pytest.approx(K.T) == K
    assert K @ (turned + np.array([1.0, 2.0, 3.0])).ravel() == pytest.approx(0, abs=1e-12)
    stretched = np.zeros_like(x)
    stretched[:, 0] = 0.1 * x[:, 0]
    energy = 0.5 * stretched.ravel() @ K @ stretched.ravel()
    assert energy == pytest.approx(0.5 * (lam + 2 * mu) * 0.1**2 * edge**3)
