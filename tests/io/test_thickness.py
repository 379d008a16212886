"""What a mesh cannot show is filled, left out or refused; voxels that touch at edges or corners are joined."""

import logging
import re
from itertools import product

import numpy as np
import pytest

from bayesreg.config.sections import MeshConfig
from bayesreg.image import Image
from bayesreg.io.datasets import Anatomy
from bayesreg.io.domain import MeshError, mesh_domain, size_of_solid
from bayesreg.io.thickness import critical_blocks, resolved, simplified, well_composed
from bayesreg.tissues import BRAIN_CLOSING
from bayesreg.workflow.appraisal import explain_mesh
from bayesreg.workflow.meshing import complete_lengths, mesh_of
from tests.io.masks import KINDS, random_mask


def critical_by_hand(mask):
    """The number of blocks of each kind, voxel by voxel."""
    counts = []
    for extent in ((2, 2, 1), (2, 1, 2), (1, 2, 2), (2, 2, 2)):
        count = 0
        for first in product(*(range(n - e + 1) for n, e in zip(mask.shape, extent, strict=True))):
            block = mask[tuple(slice(f, f + e) for f, e in zip(first, extent, strict=True))].ravel()
            values = [block, ~block]
            count += any(v.sum() == 2 and (v & v[::-1]).sum() == 2 for v in values)
        counts.append(count)
    return counts


def image_of(mask, sizes=(1.0, 1.0, 1.0)):
    return Image(mask.astype(np.uint8), np.diag([*sizes, 1.0]))


def box(shape=(24, 24, 24), margin=4):
    mask = np.zeros(shape, bool)
    mask[(slice(margin, -margin),) * 3] = True
    return mask


class TestWellComposed:
    @pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
    def test_leaves_no_contact_at_edges_or_corners(self, share):
        mask = np.random.default_rng(0).random((9, 8, 7)) < share
        assert [len(blocks) for blocks in critical_blocks(mask)] == critical_by_hand(mask)
        repaired = well_composed(mask)
        assert (repaired | mask == repaired).all()
        assert critical_by_hand(repaired) == [0, 0, 0, 0]

    @pytest.mark.parametrize("seed", range(2 * len(KINDS)))
    def test_changes_few_voxels(self, seed):
        mask = np.asarray(random_mask(seed)[1].voxels) != 0
        repaired = well_composed(mask)
        assert not any(map(len, critical_blocks(repaired)))
        assert (repaired ^ mask).sum() <= 2 * sum(map(len, critical_blocks(mask)))

    @pytest.mark.parametrize(("start", "most"), [(4, 8), (12, 2)])
    def test_joins_boxes_that_meet_at_an_edge_or_a_corner(self, start, most):
        mask = np.zeros((16, 16, 16), bool)
        mask[:8, :8, 4:12] = mask[8:, 8:, start:] = True
        assert 1 <= (well_composed(mask) ^ mask).sum() <= most

    def test_leaves_a_ball_as_it_is(self):
        ball = np.linalg.norm(np.indices((20, 20, 20)) - 9.6, axis=0) < 8
        np.testing.assert_array_equal(well_composed(ball), ball)


class TestSimplified:
    @pytest.mark.parametrize("sizes", [(1.0, 1.0, 1.0), (0.8, 0.8, 2.5)])
    @pytest.mark.parametrize("margin", [0, 4])
    def test_leaves_a_box_as_it_is(self, sizes, margin):
        mask = np.ones((24, 24, 24), bool) if margin == 0 else box()
        np.testing.assert_array_equal(simplified(image_of(mask, sizes), 7.0), mask)

    def test_leaves_out_fins_and_bridges_and_what_hangs_on_them(self):
        alone = np.zeros((60, 24, 24), bool)
        alone[4:28, 4:20, 4:20] = True
        mask = alone.copy()
        mask[28:50, 12, 12] = mask[50:56, 9:15, 9:15] = mask[10:20, 12, 20:] = True
        after = simplified(image_of(mask), 6.0)
        # The roots of what is thin stay, and corners may go.
        assert (alone & ~after).sum() <= 8
        assert not after[32:].any()
        assert not after[:, :, 23:].any()

    def test_keeps_what_is_thick_enough(self):
        mask = box()
        mask[10:14, 12:, :] = False
        mask[5:9, 8:12, 20:] = True
        assert (simplified(image_of(mask), 6.0) ^ mask).sum() <= 4


class TestResolved:
    def test_tells_millilitres_and_places(self, caplog):
        mask = box((64, 64, 64), 8)
        mask[56:64, 30:32, 20:50] = True
        with caplog.at_level(logging.WARNING):
            region = np.asarray(resolved(image_of(mask, (2.0, 2.0, 2.0)), 20.0).voxels) != 0
        lost = (mask & ~region).sum() * 8e-3
        assert 0 < lost < 480 * 8e-3
        assert f"{lost:.3g} ml of the region to mesh left out, about (12" in caplog.text
        assert "61, 69) mm, which are thinner than 6 mm or hang on such parts" in caplog.text

    def test_refuses_two_bodies_on_a_bridge(self):
        mask = np.zeros((48, 20, 20), bool)
        mask[4:20, 4:16, 4:16] = mask[28:44, 4:16, 4:16] = mask[20:28, 10, 10] = True
        with pytest.raises(MeshError, match=r"2\.\d+ ml of the 4\.\d+ ml of .* about \(3\d, 10, 10\) mm"):
            resolved(image_of(mask), 6.0)


# Longer edges than the usual ones, so that a mesh takes seconds.
LONGER = 1.7


def mesh_or_reason(image, names):
    """The mesh as a run makes it, or the sentence that says why there is none."""
    size = size_of_solid(image, names)
    try:
        domain = mesh_domain(image, None, size * BRAIN_CLOSING, names)
        return mesh_of(Anatomy(None, image, None, names), domain, complete_lengths(MeshConfig(), LONGER * size))
    except MeshError as error:
        return str(error)


@pytest.mark.parametrize("seed", [8, 32], ids=["a mixture", "a box of two tissues"])
def test_masks_whose_boundary_touched_itself_are_meshed(seed):
    _, image, names = random_mask(seed)
    mesh = mesh_or_reason(image, names)
    assert mesh.volumes.sum() == pytest.approx(np.count_nonzero(image.voxels) * image.voxel_volume, rel=0.06)


def test_the_hole_of_a_shell_is_filled_and_told(caplog):
    radius = np.linalg.norm(np.indices((40, 40, 40)) - 19.5, axis=0)
    shell = image_of((radius < 18) & (radius > 15))
    with caplog.at_level(logging.WARNING):
        mesh = mesh_or_reason(shell, ("organ",))
    assert f"{np.count_nonzero(radius <= 15) / 1000:.3g} ml of holes in the region to mesh filled" in caplog.text
    assert mesh.volumes.sum() == pytest.approx(4 / 3 * np.pi * 18**3, rel=0.03)
    assert "The mesh holds 24" in explain_mesh(mesh, shell)[0]


@pytest.mark.long
@pytest.mark.parametrize("seed", range(200))
def test_every_mask_is_meshed_or_refused_in_one_sentence(seed, caplog):
    """A mesh holds the volume of its labels, or it is told why not; a refusal says what, where and what to do."""
    _, image, names = random_mask(seed)
    with caplog.at_level(logging.WARNING):
        outcome = mesh_or_reason(image, names)
    if isinstance(outcome, str):
        assert re.search(r"about \(.*\) mm.*give|the mesh holds .* ml of .*; choose a shorter", outcome), outcome
        assert "\n" not in outcome
    else:
        volume = np.count_nonzero(image.voxels) * image.voxel_volume
        told = explain_mesh(outcome, image) or re.search(r"ml of (holes|the region)|ml together", caplog.text)
        assert told or outcome.volumes.sum() == pytest.approx(volume, rel=0.1)
