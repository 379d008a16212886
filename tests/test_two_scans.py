"""A run of two scans in files: pose, contrast, ignored places, another pair of images, and what is written of them."""

from __future__ import annotations

import json

import nibabel as nib
import numpy as np
import pytest
import SimpleITK
from ruamel.yaml import YAML

import bayesreg as br
from bayesreg.config import make_config
from bayesreg.io import store
from bayesreg.io.quality import edge_lengths
from bayesreg.report.panels import View, ignored
from bayesreg.report.slices import planes_through
from bayesreg.tissues import BRAIN_EDGE, BRAIN_VOLUME
from bayesreg.workflow.assembly import _observations
from bayesreg.workflow.preparation import prepare
from tests.io.test_alignment import FIXED, MASK, motion
from tests.phantoms import ball_mesh

POSE = motion(8.0, 8.0, seed=6)
# The scanner's units.
SCALE, OFFSET = 400.0, 30.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans")
    rng = np.random.default_rng(2)
    fixed = np.asarray(FIXED.voxels)
    inside = np.asarray(MASK.voxels) != 0
    other = np.where(inside, 2 - fixed, 0.0)
    cavity = np.zeros(FIXED.shape, np.uint8)
    cavity[22:27, 30:35, 20:25] = 1
    in_scan = POSE.inverse.aligned(FIXED).affine
    files = {
        "fixed": (SCALE * (fixed + 0.02 * rng.normal(size=FIXED.shape)) + OFFSET, FIXED.affine),
        "moving": (SCALE * (other + 0.02 * rng.normal(size=FIXED.shape)) + OFFSET, in_scan),
        "flair_fixed": (fixed + 0.05 * rng.normal(size=FIXED.shape), FIXED.affine),
        "flair_moving": (3 * fixed + 0.05 * rng.normal(size=FIXED.shape), in_scan),
        "organ": (inside.astype(np.uint8), FIXED.affine),
        "cavity": (cavity, in_scan),
    }
    for name, (voxels, affine) in files.items():
        kind = np.uint8 if voxels.dtype == np.uint8 else np.float32
        nib.save(nib.Nifti1Image(voxels.astype(kind), affine), folder / f"{name}.nii.gz")
    whole = ball_mesh(radius=36, spacing=26)
    mesh = br.TetMesh.from_arrays(
        whole.points - (5.0, -3.0, 8.0), whole.cells, np.zeros(len(whole.cells), int), ("organ",)
    )
    br.save_mesh(mesh, folder / "mesh.vtu")
    content = {
        "data": {"source": "files", "fixed": "fixed.nii.gz", "moving": "moving.nii.gz", "labels": "organ.nii.gz",
                 "label_table": "mask", "moving_ignore": "cavity.nii.gz"},
        "mesh": {"file": "mesh.vtu"},
        "observations": [{"kind": "images"}, {"kind": "images", "name": "flair", "fixed": "flair_fixed.nii.gz",
                                              "moving": "flair_moving.nii.gz"}],
        "model": {"preset": "paper", "t_similarity": 0.3, "interpolation": "cubic", "quadrature": "gauss32",
                  "fixed": {"lam": 10.0, "mu": 1.0}},
        "sampler": {"name": "laplace", "chains": 2},
        "stop": {"rhat": None, "max_steps": 200},
    }  # fmt: skip
    YAML(typ="safe").dump(content, folder / "run.yaml")
    return folder


@pytest.fixture(scope="module")
def result(folder):
    return br.run(folder / "run.yaml", folder / "out", progress=False)


def test_the_pose_is_found_and_so_is_the_contrast(result):
    found = result.run.matching
    at = result.mesh.points
    assert np.linalg.norm(found.pose.place(at) - POSE.place(at), axis=1).mean() < 0.3
    assert not found.one_contrast
    assert result.run.channels["flair"].one_contrast
    notes = " ".join(result.run.manifest["appraisal"]["notes"])
    assert "off the headers" in notes
    assert "unlike" in notes


def test_the_displacement_counts_from_one_world_to_the_other(result):
    """SimpleITK takes points of the fixed image to where they lie in the moving one, within the organ and without."""
    image = SimpleITK.ReadImage(str(result.folder / "displacement_mean.nii.gz"), SimpleITK.sitkVectorFloat64)
    transform = SimpleITK.DisplacementFieldTransform(image)
    flip = np.array([-1.0, -1.0, 1.0])
    for point in ((0.0, 0.0, 0.0), (20.0, -10.0, 5.0), (-60.0, 50.0, 40.0)):
        there = flip * transform.TransformPoint((flip * point).tolist())
        np.testing.assert_allclose(there, POSE.place(np.array(point)), atol=0.5)


def test_the_rigid_part_of_the_draws_is_the_pose(result):
    draws = result.pose
    expected = POSE.about(np.asarray(result.run.predicted.centre))
    np.testing.assert_allclose(draws.translation.mean(axis=(0, 1)), expected.translation, atol=0.3)
    np.testing.assert_allclose(draws.rotation.mean(axis=(0, 1)), expected.rotation, atol=0.5)
    assert (draws.translation.std(axis=(0, 1)) > 0).all()


def test_standard_deviations_are_those_along_the_axes_of_the_moving_world(result):
    draws = result.idata.posterior["u_boundary"].to_numpy()
    turned = (draws @ np.asarray(result.run.matching.pose.rotation).T).reshape(-1, *draws.shape[2:])
    nodes = np.asarray(result.idata.posterior["node"])
    found = np.asarray(result.run.predicted.total_sd)[nodes]
    np.testing.assert_allclose(found, turned.std(axis=0), rtol=0.05)


def test_the_warped_image_is_in_the_units_of_the_file(result):
    warped = np.asarray(br.load_image(result.folder / "warped_mean.nii.gz").voxels)
    inside = np.asarray(MASK.voxels) != 0
    expected = SCALE * (2 - np.asarray(FIXED.voxels)) + OFFSET
    assert np.corrcoef(warped[inside], expected[inside])[0, 1] > 0.95
    assert np.median(warped[inside]) == pytest.approx(np.median(expected[inside]), rel=0.05)


def test_what_was_found_is_kept_with_the_run(result, folder):
    inputs = store.read_inputs(folder / "out")
    np.testing.assert_allclose(inputs.matching.pose.matrix, result.run.matching.pose.matrix)
    assert inputs.moving_ignore is not None
    assert set(inputs.channels) == {"flair"}
    kept = json.loads((folder / "out" / "inputs" / "matching.json").read_text())
    assert kept["channels"] == {"flair": True}


def test_the_report_shows_it(result):
    page = result.report.read_text(encoding="utf-8")
    assert "Where the moving image lies" in page
    assert "The rigid part of the displacement" in page
    assert "borders of the tissues in the fixed image" in page
    assert "What is hatched is ignored" in page


def test_what_is_hatched_goes_with_the_displacement(result):
    """A pixel of the warped image is hatched where the posterior mean takes it into the mask."""
    run = result.run
    mask = run.moving_ignore
    view = View.of(run)
    through = planes_through(run.mesh, mask.voxel_to_world(np.argwhere(np.asarray(mask.voxels) != 0).mean(axis=0)))
    for plane in through:
        fixed, moving, warped = ignored(view, plane)
        assert not fixed.any()
        assert moving.any()
        u = view.slice(plane).nodal(run.u_mean)
        inside = np.isfinite(u).all(axis=-1)
        there = np.rint(mask.world_to_voxel(plane.points()[inside] + u[inside])).astype(int)
        there = np.clip(there, 0, np.array(mask.shape) - 1)
        np.testing.assert_array_equal(warped[inside], np.asarray(mask.voxels)[tuple(there.T)] != 0)


def test_a_channel_on_another_grid_has_the_tissues_where_they_are(result, folder):
    """The same image stored backwards along its first axis, of the same shape."""
    config = br.load_config(folder / "run.yaml")
    inputs = store.read_inputs(folder / "out")
    channel = inputs.channels["flair"]
    affine = channel.fixed.affine.copy()
    affine[:3, 3] = channel.fixed.voxel_to_world(np.array([channel.fixed.shape[0] - 1.0, 0, 0]))
    affine[:3, 0] *= -1
    backwards = channel._replace(fixed=br.Image(np.asarray(channel.fixed.voxels)[::-1], affine))
    first, second = _observations(config, inputs._replace(channels={"flair": backwards}))[:2]
    np.testing.assert_array_equal(np.asarray(second.tissue.voxels)[::-1], first.tissue.voxels)


def test_the_headers_are_kept_where_one_says_so(folder):
    config = br.load_config(folder / "run.yaml", ["data.pose=fixed"])
    found = prepare(config)
    assert found.inputs.matching.pose.is_identity
    assert any("data.pose: fixed" in note for note in found.appraisal.notes)


def test_the_brain_of_a_mouse_is_meshed_as_finely_as_it_is_small(tmp_path):
    """All lengths are those of a human brain in proportion: edges, the gap to the skull, the levels of the pose."""
    small = np.diag([0.1, 0.1, 0.1, 1.0])
    for name, image in (("fixed", FIXED), ("moving", FIXED), ("mask", MASK)):
        nib.save(nib.Nifti1Image(np.asarray(image.voxels, np.float32), small @ image.affine), tmp_path / f"{name}.nii")
    data = {"source": "files", **{name: str(tmp_path / f"{name}.nii") for name in ("fixed", "moving")}}
    config = make_config({"data": {**data, "intracranial": str(tmp_path / "mask.nii")}})
    mesh = prepare(config).inputs.mesh
    volume = np.count_nonzero(MASK.voxels) * MASK.voxel_volume / 1000
    assert mesh.volumes.sum() == pytest.approx(volume, rel=0.15)
    edge = float(np.median(edge_lengths(mesh.points, mesh.cells)))
    assert edge == pytest.approx(BRAIN_EDGE * np.cbrt(volume / BRAIN_VOLUME), rel=0.3)
