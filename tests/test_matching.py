"""What is found of a pair before the model sees it: contrast and scale, with parts that are ignored."""

from __future__ import annotations

import numpy as np
import pytest

import bayesreg as br
from bayesreg.config.data import FilesData
from bayesreg.image import Image
from bayesreg.types import InputError
from bayesreg.workflow.matching import match_channel, match_images
from tests.test_appraisal import DOMAIN, FIXED

DATA = FilesData.model_construct(source="files", pose="fixed", same_contrast=None)
METAL = np.s_[25:32, 20:27, 15:22]
# A mask of its own grid, which holds what it ignores and no more.
CORNER = FIXED.voxel_to_world(np.array([25.0, 20.0, 15.0]))
MASK = Image(np.ones((7, 7, 7), np.uint8), np.c_[FIXED.affine[:, :3], [*CORNER, 1.0]])


def with_metal(image):
    voxels = np.array(image.voxels)
    voxels[METAL] = 1e5
    return image.with_voxels(voxels)


STUDENT_T = br.StudentT()


def match(fixed=FIXED, moving=FIXED, similarity=STUDENT_T, **ignored):
    return match_images(DATA, similarity, DOMAIN, fixed, moving, **ignored)


@pytest.mark.parametrize("which", ["fixed", "moving"])
def test_metal_that_is_ignored_changes_neither_contrast_nor_scale(which):
    plain, masked = match(), match(**{which: with_metal(FIXED)}, **{f"{which}_ignore": MASK})
    assert masked.matching.one_contrast
    for name in ("fixed", "moving"):
        plain_voxels, masked_voxels = (np.asarray(getattr(matched, name).voxels) for matched in (plain, masked))
        away = np.ones(plain_voxels.shape, bool)
        away[METAL] = False
        np.testing.assert_allclose(masked_voxels[away], plain_voxels[away], atol=0.1)
    assert masked.likeness.correlation > 0.99
    assert any(f"2.74 ml of the organ in the {which} image" in note for note in masked.notes)
    assert not masked.warnings


def test_metal_that_is_not_ignored_would():
    assert match(moving=with_metal(FIXED)).likeness.correlation < 0.5


def test_a_channel_is_scaled_by_what_is_seen():
    matched = match(moving_ignore=MASK)
    plain = match_channel(DATA, DOMAIN, matched, "flair", FIXED, FIXED)
    metal_channel = match_channel(DATA, DOMAIN, matched, "flair", FIXED, with_metal(FIXED))
    assert np.median(np.asarray(metal_channel.moving.voxels)) == pytest.approx(
        np.median(np.asarray(plain.moving.voxels))
    )


@pytest.mark.parametrize(
    ("mask", "sentence"),
    [
        (Image(MASK.voxels, np.c_[MASK.affine[:, :3], [900.0, 0, 0, 1]]), "ignores nothing of the organ"),
        (DOMAIN.with_voxels(np.arange(60)[:, None, None] * np.ones(DOMAIN.shape) < 45), "of the organ; what is not"),
    ],
)
def test_a_mask_elsewhere_or_of_nearly_all_is_told(mask, sentence):
    assert sentence in " ".join(match(fixed_ignore=mask).warnings)


def test_a_mask_of_all_the_organ_is_refused():
    with pytest.raises(InputError, match="all of the organ is ignored"):
        match(moving_ignore=DOMAIN)


def test_a_similarity_that_serves_any_contrast_is_named():
    inverted = FIXED.with_voxels(-np.asarray(FIXED.voxels))
    assert "compared by mind, which serves any" in " ".join(
        match(moving=inverted, similarity=br.SelfSimilarity()).notes
    )
    assert "through a map of the fixed image" in " ".join(match(moving=inverted).notes)
