"""What is said of a pair before any search: each way in which it can be wrong has its sentence."""

import numpy as np
import pytest
from scipy import ndimage

from bayesreg.image import Image
from bayesreg.mesh import TetMesh
from bayesreg.workflow.appraisal import appraise, compare_images, explain_mesh
from tests.phantoms import box_mesh

AFFINE = np.diag([2.0, 2.0, 2.0, 1.0])
SHAPE = (60, 50, 40)
RADIUS = np.linalg.norm((np.indices(SHAPE).T - (29.5, 24.5, 19.5)) / (26, 20, 16), axis=-1).T
DOMAIN = Image((RADIUS < 1).astype(np.uint8), AFFINE)
TISSUE = Image(np.where(RADIUS < 0.5, 2, 1) * np.asarray(DOMAIN.voxels, np.int8), AFFINE)
TEXTURE = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=SHAPE), 3.0)
FIXED = Image(TEXTURE / TEXTURE.std() + 3 * (RADIUS < 0.5), AFFINE)


def moved_by(millimetres):
    affine = AFFINE.copy()
    affine[0, 3] = millimetres
    return Image(FIXED.voxels, affine)


def told(moving, **options):
    return " ".join(appraise(TISSUE, DOMAIN, ("gm", "wm"), compare_images(FIXED, moving, DOMAIN), **options).warnings)


@pytest.mark.parametrize(
    "moving", [FIXED, moved_by(3.0), FIXED.with_voxels(1.5 * FIXED.voxels + 0.5)], ids=["same", "near", "scaled"]
)
def test_a_sound_pair_has_no_sentence(moving):
    assert told(moving) == ""


@pytest.mark.parametrize(
    ("moving", "sentence"),
    [
        (Image(FIXED.voxels.transpose(2, 1, 0)[::-1], AFFINE), "axes of one are mistaken"),
        (moved_by(60.0), "they are not aligned"),
        (FIXED.with_voxels(-FIXED.voxels), "Bright and dark change places"),
        (Image(FIXED.voxels[:, :, :20], AFFINE), "50% of the organ lies beyond the grid of the moving image"),
        (FIXED.with_voxels(4 * FIXED.voxels + 300), "range 4 times as far"),
        (FIXED.with_voxels(FIXED.voxels + 300), "ranges from them"),
        (FIXED.with_voxels(np.zeros(SHAPE)), "hardly alike"),
    ],
    ids=["axes", "moved", "inverted", "slab", "scale", "offset", "constant"],
)
def test_each_fault_has_its_sentence(moving, sentence):
    assert sentence in told(moving)


def test_scales_of_their_own_may_differ():
    assert told(FIXED.with_voxels(4 * FIXED.voxels + 300), one_scale=False) == ""


def test_contrasts_of_their_own_may_differ():
    assert told(FIXED.with_voxels(-FIXED.voxels), one_contrast=False, one_scale=False) == ""


def test_likeness_of_what_it_is_known_for():
    likeness = compare_images(FIXED, FIXED, DOMAIN)
    assert likeness.correlation == pytest.approx(1)
    assert likeness.mutual_information == pytest.approx(1)
    assert likeness.scale_ratio == pytest.approx(1)
    noise = FIXED.with_voxels(np.random.default_rng(1).normal(size=SHAPE))
    assert abs(compare_images(FIXED, noise, DOMAIN).correlation) < 0.03
    assert compare_images(FIXED, noise, DOMAIN).mutual_information < 0.02


def test_tissue_outside_the_region_is_told_in_millilitres():
    smaller = DOMAIN.with_voxels((RADIUS < 0.9).astype(np.uint8))
    appraisal = appraise(TISSUE, smaller, ("gm", "wm"))
    inside, outside = appraisal.millilitres["gm"]
    assert inside + outside == pytest.approx((TISSUE.voxels == 1).sum() * 8 / 1000)
    assert appraisal.millilitres["wm"][1] == 0
    assert appraisal.warnings == (
        f"{outside:.3g} of {inside + outside:.3g} ml of GM lie outside the region to mesh, which leaves them out.",
    )


@pytest.mark.parametrize(("names", "warned"), [(("gm", "wm"), 1), (("gm", "csf"), 0)])
def test_a_mesh_with_other_volumes_than_its_labels_is_told_unless_it_fills_folds(names, warned):
    box = box_mesh(2)
    tissue = (box.points[box.cells].mean(axis=1)[:, 0] > np.ptp(box.points[:, 0]) * 0.7).astype(int)
    mesh = TetMesh.from_arrays(box.points, box.cells, tissue, names)
    volumes = np.bincount(tissue, mesh.volumes)
    labels = np.repeat([1, 2], np.rint([volumes[0] * 0.85, volumes[1] + volumes[0] * 0.15]).astype(int))[None, None]
    told = explain_mesh(mesh, Image(labels, np.eye(4)))
    assert sum("ml of GM, and the labels" in sentence for sentence in told) == warned
    assert not any("CSF" in sentence for sentence in told)


def fine_structures(seed):
    """A brain's mixture of fine and coarse structures, on a grid of 2 mm."""
    rng = np.random.default_rng(seed)
    fine, coarse = (ndimage.gaussian_filter(rng.normal(size=SHAPE), sd) for sd in (1.0, 6.0))
    return Image(fine / fine.std() + coarse / coarse.std(), AFFINE)


@pytest.mark.parametrize("contrast", [1.0, -1.0], ids=["one contrast", "inverted"])
def test_fine_structures_that_moved_are_not_of_another_contrast_from_place_to_place(contrast):
    fixed, rng = fine_structures(0), np.random.default_rng(1)
    bend = np.stack([ndimage.gaussian_filter(rng.normal(size=SHAPE), 8) for _ in range(3)])
    # 2.5 voxels, or 5 mm, in each direction.
    places = np.indices(SHAPE) + 2.5 * bend / bend.std()
    moved = ndimage.map_coordinates(fixed.voxels, places, order=1, mode="nearest") + 0.1 * rng.normal(size=SHAPE)
    likeness = compare_images(fixed, fixed.with_voxels(contrast * moved), DOMAIN)
    assert not likeness.is_related_in_patches


def test_a_contrast_of_each_place_is_found():
    fixed, rng = fine_structures(0), np.random.default_rng(2)
    gain = np.sign(ndimage.gaussian_filter(rng.normal(size=SHAPE), 5))
    moving = fixed.with_voxels(gain * fixed.voxels + 2 * rng.normal(size=SHAPE))
    assert compare_images(fixed, moving, DOMAIN).is_related_in_patches
