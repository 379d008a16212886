"""A moving image that shows a part of the organ: an ultrasound's wedge, without labels and mask."""

from __future__ import annotations

import nibabel as nib
import numpy as np
import pytest

from bayesreg.config import make_config
from bayesreg.pose import Pose
from bayesreg.workflow.preparation import prepare
from tests.model.test_image_pose import FIXED, MASK, moved


@pytest.mark.long
def test_the_organ_is_what_both_images_show(tmp_path):
    moving = moved(Pose.identity())
    points = moving.grid_points()
    seen = points[..., 2] > np.abs(points[..., 0]) - 20
    files = {"fixed": np.asarray(FIXED.voxels), "moving": np.where(seen, moving.voxels, 0.0)}
    for name, voxels in files.items():
        nib.save(nib.Nifti1Image(voxels.astype(np.float32), FIXED.affine), tmp_path / f"{name}.nii.gz")
    paths = {name: str(tmp_path / f"{name}.nii.gz") for name in files}
    config = make_config({"data": {"source": "files", **paths}, "observations": [{"kind": "images"}]}, [])
    prepared = prepare(config)
    tissue = np.asarray(prepared.inputs.tissue.voxels) != 0
    assert not tissue[~seen].any()
    visible = seen & (np.asarray(MASK.voxels) != 0)
    assert tissue[visible].mean() > 0.9
    volume = prepared.inputs.mesh.volumes.sum()
    assert volume == pytest.approx(tissue.sum() * FIXED.voxel_volume, rel=0.05)
    assert prepared.inputs.matching.pose.is_identity
