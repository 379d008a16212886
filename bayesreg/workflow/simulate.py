"""Make the synthetic pair of a configuration, and write it into a folder."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from bayesreg.config import Config, load_config
from bayesreg.config.data import Scan
from bayesreg.io.records import Inputs
from bayesreg.io.run_folder import RunFolder
from bayesreg.io.volumes import save_image
from bayesreg.pose import Motion, Pose
from bayesreg.tissues import is_fluid
from bayesreg.types import InputError
from bayesreg.workflow.preparation import prepared_inputs, store_inputs, with_unsampled

SCANS = "scans"


def simulate(config: str | Path | Config, out: str | Path) -> Path:
    """Make the synthetic pair of a configuration: images, tissue, skull, mesh and truth in a folder.

    With `simulate.scan` the subfolder scans holds the files of two scans, too: fixed, moving, labels, intracranial and,
    if the moving scan has one, cavity, each as .nii.gz.
    """
    config = config if isinstance(config, Config) else load_config(config)
    if config.simulate is None:
        raise InputError("the configuration has no section 'simulate': its pair comes from files")
    began, folder = time.perf_counter(), RunFolder(Path(out))
    folder.require_fresh()
    inputs, provenance = prepared_inputs(config)
    with folder.locked():
        store_inputs(folder, inputs, with_unsampled(provenance, began))
    if config.simulate.scan is not None:
        _write_scans(folder.path / SCANS, inputs, config.simulate.scan, config.seed)
    return folder.path


def _write_scans(folder: Path, inputs: Inputs, scan: Scan, seed: int) -> None:
    assert inputs.fixed is not None
    assert inputs.moving is not None
    assert inputs.skull is not None
    assert inputs.truth is not None
    inside = np.asarray(inputs.skull.voxels) == 0
    voxels, cavity = np.array(inputs.moving.voxels), _cavity(inputs, scan.cavity)
    fluid = [index for index, name in enumerate(inputs.mesh.names, start=1) if is_fluid(name)]
    voxels[cavity] = np.median(np.asarray(inputs.fixed.voxels)[np.isin(np.asarray(inputs.tissue.voxels), fluid)])
    if scan.inverted:
        voxels[inside] = voxels[inside].max() + voxels[inside].min() - voxels[inside]
    # The pose changes the affine and no voxel: the grid moves with the organ.
    pose = _pose(inputs.mesh.points.mean(axis=0), scan, seed)
    moving = pose.inverse.aligned(inputs.moving.with_voxels(voxels))
    written = {
        "fixed": inputs.fixed,
        "moving": moving,
        "labels": inputs.tissue,
        "intracranial": inputs.skull.with_voxels(inside.astype(np.uint8)),
    }
    if cavity.any():
        written["cavity"] = moving.with_voxels(cavity.astype(np.uint8))
    folder.mkdir(parents=True)
    for name, image in written.items():
        save_image(image, folder / f"{name}.nii.gz")


def _cavity(inputs: Inputs, radius: float) -> np.ndarray:
    """Mark a ball inside the moved organ that touches its surface where it moved most; (X, Y, Z) booleans."""
    assert inputs.truth is not None
    u, points = np.asarray(inputs.truth.u), inputs.mesh.points
    most = np.linalg.norm(u, axis=1).argmax()
    inwards = points.mean(axis=0) - points[most]
    centre = points[most] + u[most] + radius * inwards / np.linalg.norm(inwards)
    return np.linalg.norm(inputs.tissue.grid_points() - centre, axis=-1) < radius


def _pose(centre: np.ndarray, scan: Scan, seed: int) -> Pose:
    """Make a rigid motion about a centre, with random directions of its shift and its axis."""
    shift, axis = (way / np.linalg.norm(way) for way in np.random.default_rng(seed).normal(size=(2, 3)))
    return Motion(scan.millimetres * shift, scan.degrees * axis).pose(centre)
