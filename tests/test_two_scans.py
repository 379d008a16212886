"""A run of two scans in files: pose, contrast, ignored places, another pair of images, and what is written of them."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from xml.etree import ElementTree

import nibabel as nib
import numpy as np
import pytest
import pyvista
import SimpleITK
from ruamel.yaml import YAML

import bayesreg as br
from bayesreg.config import make_config
from bayesreg.io import store
from bayesreg.io.quality import edge_lengths
from bayesreg.io.run_folder import RunFolder
from bayesreg.mesh import signed_volumes
from bayesreg.messages import from_level
from bayesreg.report.panels import View, ignored
from bayesreg.report.slices import planes_through
from bayesreg.results.slicer import slicer
from bayesreg.tissues import BRAIN_EDGE, BRAIN_VOLUME
from bayesreg.workflow.preparation import prepare
from tests.model.test_image_pose import FIXED, MASK, motion
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
    inverted = np.where(inside, 2 - fixed, 0.0)
    cavity = np.zeros(FIXED.shape, np.uint8)
    cavity[22:27, 30:35, 20:25] = 1
    in_scan = POSE.inverse.aligned(FIXED).affine
    files = {
        "fixed": (SCALE * (fixed + 0.02 * rng.normal(size=FIXED.shape)) + OFFSET, FIXED.affine),
        "moving": (SCALE * (inverted + 0.02 * rng.normal(size=FIXED.shape)) + OFFSET, in_scan),
        "flair_fixed": (fixed + 0.05 * rng.normal(size=FIXED.shape), FIXED.affine),
        "flair_moving": (3 * fixed + 0.05 * rng.normal(size=FIXED.shape), in_scan),
        "organ": (inside.astype(np.uint8), FIXED.affine),
        "cavity": (cavity, in_scan),
    }
    for name, (voxels, affine) in files.items():
        kind = np.uint8 if voxels.dtype == np.uint8 else np.float32
        nib.save(nib.Nifti1Image(voxels.astype(kind), affine), folder / f"{name}.nii.gz")
    ball = ball_mesh(radius=36, spacing=26)
    mesh = br.TetMesh.from_arrays(
        ball.points - (5.0, -3.0, 8.0), ball.cells, np.zeros(len(ball.cells), int), ("organ",)
    )
    br.save_mesh(mesh, folder / "mesh.vtu")
    compared = {
        "kind": "images", "similarity": {"kind": "ssd", "temperature": 0.3}, "interpolation": "cubic",
        "quadrature": "gauss32",
    }  # fmt: skip
    content = {
        "data": {"source": "files", "fixed": "fixed.nii.gz", "moving": "moving.nii.gz", "labels": "organ.nii.gz",
                 "label_table": "mask", "moving_ignore": "cavity.nii.gz"},
        "mesh": {"file": "mesh.vtu"},
        "observations": [compared, {**compared, "name": "flair", "fixed": "flair_fixed.nii.gz",
                                    "moving": "flair_moving.nii.gz"}],
        "model": {"preset": "paper", "fixed": {"lam": 10.0, "mu": 1.0}},
        "sampler": {"name": "laplace", "chains": 2},
        "stop": {"rhat": None, "max_steps": 200},
        "results": {"draws": 4, "bids": {"subject": "01", "session": "or"}},
    }  # fmt: skip
    YAML(typ="safe").dump(content, folder / "run.yaml")
    return folder


@pytest.fixture(scope="module")
def result(folder):
    return br.run(folder / "run.yaml", folder / "out", progress=False)


def test_the_pose_is_found_and_so_is_the_contrast(result):
    matching = result.run.matching
    points = result.mesh.points
    assert np.linalg.norm(matching.pose.place(points) - POSE.place(points), axis=1).mean() < 0.3
    assert not matching.one_contrast
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
        displaced = flip * transform.TransformPoint((flip * point).tolist())
        np.testing.assert_allclose(displaced, POSE.place(np.array(point)), atol=0.5)


def test_the_rigid_part_of_the_draws_is_the_pose(result):
    draws = result.pose
    expected = POSE.about(np.asarray(result.run.predicted.centre))
    np.testing.assert_allclose(draws.translation.mean(axis=(0, 1)), expected.translation, atol=0.3)
    np.testing.assert_allclose(draws.rotation.mean(axis=(0, 1)), expected.rotation, atol=0.5)
    assert (draws.translation.std(axis=(0, 1)) > 0).all()


def test_the_warped_image_is_in_the_units_of_the_file(result):
    warped = np.asarray(br.load_image(result.folder / "warped_mean.nii.gz").voxels)
    inside = np.asarray(MASK.voxels) != 0
    expected = SCALE * (2 - np.asarray(FIXED.voxels)) + OFFSET
    assert np.corrcoef(warped[inside], expected[inside])[0, 1] > 0.95
    assert np.median(warped[inside]) == pytest.approx(np.median(expected[inside]), rel=0.05)


def test_what_was_found_is_kept_with_the_run(result, folder):
    inputs = store.read_inputs(RunFolder(folder / "out"))
    np.testing.assert_allclose(inputs.matching.pose.matrix, result.run.matching.pose.matrix)
    assert inputs.moving_ignore is not None
    assert set(inputs.channels) == {"flair"}
    stored = json.loads((folder / "out" / "inputs" / "matching.json").read_text())
    assert stored["channels"] == {"flair": True}


def test_the_report_shows_it(result):
    page = result.report.read_text(encoding="utf-8")
    assert "from where the header of" in page
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
        voxel = np.rint(mask.world_to_voxel(plane.points()[inside] + u[inside])).astype(int)
        voxel = np.clip(voxel, 0, np.array(mask.shape) - 1)
        np.testing.assert_array_equal(warped[inside], np.asarray(mask.voxels)[tuple(voxel.T)] != 0)


def test_a_channel_on_another_grid_has_the_tissues_where_they_are(result, folder):
    """The same image stored backwards along its first axis, of the same shape."""
    config = br.load_config(folder / "run.yaml")
    inputs = store.read_inputs(RunFolder(folder / "out"))
    channel = inputs.channels["flair"]
    affine = channel.fixed.affine.copy()
    affine[:3, 3] = channel.fixed.voxel_to_world(np.array([channel.fixed.shape[0] - 1.0, 0, 0]))
    affine[:3, 0] *= -1
    backwards = channel._replace(fixed=br.Image(np.asarray(channel.fixed.voxels)[::-1], affine))
    inputs = inputs._replace(channels={"flair": backwards})
    first, second = (pair for section in config.observations[:2] for pair in section.observe(inputs))
    np.testing.assert_array_equal(np.asarray(second.tissue.voxels)[::-1], first.tissue.voxels)


def test_the_headers_are_kept_where_one_says_so(folder):
    config = br.load_config(folder / "run.yaml", ["data.pose=fixed"])
    prepared = prepare(config)
    assert prepared.inputs.matching.pose.is_identity
    assert any("data.pose: fixed" in note for note in prepared.appraisal.notes)


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


def test_the_composite_alone_makes_the_warped_image(result):
    """SimpleITK with transform_mean.h5, the moving image of the run and nothing else."""
    moving = store.read_inputs(RunFolder(result.folder)).moving
    scaled = result.run.matching.scale.undo(result.run.matching.pose.inverse.aligned(moving))
    br.save_image(scaled, result.folder / "own_world.nii.gz")
    fixed = SimpleITK.ReadImage(str(result.folder / "inputs" / "fixed.nii.gz"))
    image = SimpleITK.ReadImage(str(result.folder / "own_world.nii.gz"), SimpleITK.sitkFloat64)
    transform = SimpleITK.ReadTransform(str(result.folder / "transform_mean.h5"))
    by_itk = SimpleITK.GetArrayFromImage(SimpleITK.Resample(image, fixed, transform, SimpleITK.sitkLinear, np.nan))
    by_bayesreg = np.asarray(nib.load(result.folder / "warped_mean.nii.gz").dataobj)
    finite = np.isfinite(by_itk.transpose(2, 1, 0))
    assert finite.mean() > 0.5
    away = np.abs(by_itk.transpose(2, 1, 0) - by_bayesreg)[finite]
    assert np.median(away) < 1e-3 * SCALE
    assert away.max() < 0.02 * SCALE


@contextmanager
def keeping_messages() -> Iterator[list[str]]:
    """For fixtures of a module, which have no `caplog`."""
    messages: list[str] = []
    handler, log = logging.Handler(), logging.getLogger("bayesreg")
    handler.emit = lambda record: messages.append(record.getMessage())
    log.addHandler(handler)
    with from_level(logging.INFO):
        yield messages
    log.removeHandler(handler)


@pytest.fixture(scope="module")
def applied(result, folder):
    rng = np.random.default_rng(0)
    points = result.mesh.points.mean(axis=0) + rng.uniform(-15, 15, (20, 3))
    rows = [f"p{number},{','.join(map(str, point))}" for number, point in enumerate(points)]
    (folder / "p.csv").write_text("\n".join(["name,x,y,z", *rows, "far,300,0,0"]))
    ball = pyvista.Sphere(radius=12.0, center=result.mesh.points.mean(axis=0), theta_resolution=12, phi_resolution=12)
    ball.save(folder / "ball.vtk")
    ball.save(folder / "ball.stl")
    inputs = {"points": folder / "p.csv", "mesh": folder / "ball.vtk", "image": folder / "fixed.nii.gz",
              "labels": folder / "organ.nii.gz"}  # fmt: skip
    with keeping_messages() as messages:
        written = br.apply(result.folder, folder / "there", draws=40, far=(0.1, 2.0), **inputs)
    return points, written, messages


def test_apply_writes_what_it_says(applied, folder):
    points, written, messages = applied
    names = ["points.csv", "ball_in-moving.vtk", "fixed_in-moving.nii.gz", "organ_in-moving.nii.gz", "label-1.nii.gz"]
    assert [path.name for path in written] == names
    assert all(path.is_file() for path in written)
    assert "by 40 draws" in messages[0]
    assert any("1 of 21 points" in line and "nothing is known" in line for line in messages)
    assert any("RAS or LPS" in line for line in messages)
    table = np.genfromtxt(folder / "there" / "points.csv", delimiter=",", names=True, dtype=None, encoding="utf8")
    assert table["name"].tolist()[-2:] == ["p19", "far"]
    assert table["in_mesh"].tolist() == [1.0] * 20 + [0.0]
    placed = np.stack([table[axis] for axis in "xyz"], axis=1)[:20]
    assert np.linalg.norm(placed - POSE.place(points), axis=1).max() < 2.0
    assert ((table["p_over_2mm"] <= table["p_over_01mm"]) & (table["cov_xx"] >= 0))[:20].all()
    # Around the mesh there is a place, and it is not said how sure that is.
    last = table[-1]
    assert np.isfinite(last["x"])
    assert np.isnan([last["radius95"], last["cov_xx"], last["half_axis95_1"], last["p_over_2mm"]]).all()
    shortest, longest = table["half_axis95_3"][:20], table["half_axis95_1"][:20]
    assert ((0.6 * shortest < table["radius95"][:20]) & (table["radius95"][:20] <= 1.001 * longest)).all()


def test_apply_leads_back(applied, result, folder):
    points, _, _ = applied
    br.apply(result.folder, folder / "back", points=folder / "there" / "points.csv", inverse=True, draws=4)
    table = np.genfromtxt(folder / "back" / "points.csv", delimiter=",", names=True, dtype=None, encoding="utf8")
    np.testing.assert_allclose(np.stack([table[axis] for axis in "xyz"], axis=1)[:20], points, atol=1e-3)


def test_apply_carries_the_moving_image_to_the_fixed_one(result, folder):
    written = br.apply(result.folder, folder / "back", image=folder / "moving.nii.gz", inverse=True, draws=4)
    carried = np.asarray(nib.load(written[0]).dataobj)
    warped = np.asarray(nib.load(result.folder / "warped_mean.nii.gz").dataobj)
    inside = np.asarray(MASK.voxels) != 0
    # What is ignored in the moving image is filled in the run's.
    assert np.median(np.abs(carried - warped)[inside]) < 1e-3 * SCALE


def test_apply_keeps_the_space_and_the_values_of_a_surface(applied, result, folder):
    surface = pyvista.read(folder / "there" / "ball_in-moving.vtk")
    assert (folder / "there" / "ball_in-moving.vtk").read_bytes().split(b"\n")[1] == b"bayesreg SPACE=RAS"
    original = pyvista.read(folder / "ball.vtk")
    assert np.linalg.norm(surface.points - POSE.place(np.asarray(original.points, float)), axis=1).max() < 2.0
    assert {"cov_", "radius95", "half_axis95_", "p_over_2mm", "in_mesh"} <= set(surface.point_data)
    mirrored = original.copy()
    mirrored.points = np.asarray(original.points) * (-1, -1, 1)
    mirrored.save(folder / "mirrored.vtk")
    br.apply(result.folder, folder / "there", mesh=folder / "mirrored.vtk", space="LPS", draws=2)
    again = pyvista.read(folder / "there" / "mirrored_in-moving.vtk")
    np.testing.assert_allclose(np.asarray(again.points) * (-1, -1, 1), surface.points, atol=1e-3)
    written = br.apply(result.folder, folder / "there", mesh=folder / "ball.stl", draws=2)
    assert pyvista.read(written[0]).n_cells == original.n_cells


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj", ".vtp", ".vtk"])
def test_a_carried_surface_says_its_space_and_is_read_in_it(applied, result, folder, tmp_path, suffix):
    mirrored = pyvista.read(folder / "ball.vtk")
    start = np.asarray(mirrored.points, float)
    mirrored.points = start * (-1, -1, 1)
    mirrored.save(tmp_path / f"mirrored{suffix}")
    (carried,) = br.apply(result.folder, tmp_path, mesh=tmp_path / f"mirrored{suffix}", space="LPS", draws=2)
    (returned,) = br.apply(result.folder, tmp_path / "back", mesh=carried, inverse=True, draws=2)
    returned_points = np.asarray(pyvista.read(returned).points, float) * (-1, -1, 1)
    np.testing.assert_allclose(returned_points.mean(axis=0), start.mean(axis=0), atol=0.01)
    assert np.linalg.norm(returned_points[:, None] - start, axis=2).min(axis=1).max() < 1e-3
    with pytest.raises(br.InputError, match="says that its coordinates are LPS"):
        br.apply(result.folder, tmp_path, mesh=carried, space="RAS", draws=2)


def test_a_line_that_leaves_the_mesh_is_cut(applied, result, folder, tmp_path):
    """An electrode: what is left are the runs of points inside, with the values of the file."""
    middle = np.asarray(pyvista.read(folder / "ball.vtk").points, float).mean(axis=0)
    steps = np.array([0.0, 1.0, 2.0, 500.0, 500.0, -1.0, -2.0, 500.0, 3.0])
    line = pyvista.PolyData(middle + steps[:, None] * (1.0, 0, 0), lines=[9, *range(9)])
    line.point_data["contact"] = np.arange(9.0)
    line.save(tmp_path / "line.vtk")
    (path,) = br.apply(result.folder, tmp_path, mesh=tmp_path / "line.vtk", around="missing", draws=2)
    cut = pyvista.read(path)
    assert cut.point_data["contact"].tolist() == [0, 1, 2, 5, 6, 8]
    assert cut.lines.tolist() == [3, 0, 1, 2, 2, 3, 4]


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".vtk", ".vtu"])
def test_the_part_of_a_surface_around_the_mesh_can_be_left_out(applied, result, folder, tmp_path, suffix):
    surface = pyvista.read(folder / "ball.vtk")
    # Half of it is far away.
    points = np.asarray(surface.points, float)
    points[points[:, 0] > points[:, 0].mean()] += (500.0, 0, 0)
    surface.points = points
    (surface.cast_to_unstructured_grid() if suffix == ".vtu" else surface).save(tmp_path / f"half{suffix}")
    (path,) = br.apply(result.folder, tmp_path, mesh=tmp_path / f"half{suffix}", around="missing", draws=2, space="RAS")
    cut = pyvista.read(path)
    assert 0 < cut.n_cells < surface.n_cells
    assert np.isfinite(np.asarray(cut.points)).all()
    assert np.ptp(np.asarray(cut.points)[:, 0]) < 100


def test_what_lies_around_the_mesh_can_be_missing(applied, result, folder):
    inputs = {"points": folder / "p.csv", "image": folder / "fixed.nii.gz", "labels": folder / "organ.nii.gz"}
    br.apply(result.folder, folder / "alone", around="missing", draws=2, **inputs)
    table = np.genfromtxt(folder / "alone" / "points.csv", delimiter=",", names=True, dtype=None, encoding="utf8")
    assert np.isnan(table["x"][-1])
    assert np.isfinite(table["x"][:-1]).all()
    image = np.asarray(nib.load(folder / "alone" / "fixed_in-moving.nii.gz").dataobj)
    share = np.asarray(nib.load(folder / "alone" / "organ_in-moving_probability" / "label-1.nii.gz").dataobj)
    np.testing.assert_array_equal(np.isnan(image), np.isnan(share))
    assert 0.02 < np.isfinite(image).mean() < 0.9


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "nothing to carry"),
        ({"points": "none.csv"}, "no such file"),
        ({"mesh": "fixed.nii.gz"}, "unknown kind of file with a surface"),
        ({"mesh": "broken.vtk"}, "cannot be read as a surface"),
        ({"labels": "flair_fixed.nii.gz"}, "not integers"),
        ({"points": "p.csv", "draws": 1}, "at least two draws"),
        ({"points": "p.csv", "far": (0.0,)}, "above zero"),
        ({"points": "ants.csv"}, "as ANTs writes points"),
        ({"points": "said.csv", "space": "RAS"}, "says that its coordinates are LPS"),
        ({"labels": "organ.nii.gz", "margins": (0,)}, "zero stands for no label"),
        ({"labels": "nothing.nii.gz"}, "holds no label"),
        ({"image": "organ.nii.gz", "labels": "organ.nii.gz"}, "would both be carried to"),
        ({"points": "p.csv", "out": "p.csv"}, "is no folder that you may write"),
    ],
)
def test_apply_refuses(result, folder, arguments, message):
    (folder / "p.csv").exists() or (folder / "p.csv").write_text("x,y,z\n0,0,0")
    (folder / "broken.vtk").write_text("# vtk DataFile Version 3.0\nnothing\n")
    (folder / "ants.csv").write_text("x,y,z,t,label\n1,2,3,0,1\n")
    (folder / "said.csv").write_text("# CoordinateSystem = LPS\nx,y,z\n1,2,3\n")
    br.save_image(MASK.with_voxels(np.zeros(MASK.shape, np.uint8)), folder / "nothing.nii.gz")
    paths = {"points", "image", "labels", "mesh", "out"}
    files = {key: folder / value if key in paths else value for key, value in arguments.items()}
    with pytest.raises(br.InputError, match=message):
        br.apply(result.folder, files.pop("out", folder / "refused"), **files)
    assert not (folder / "refused").exists()


def test_apply_does_not_replace_what_it_was_given(result, folder):
    (folder / "points.csv").write_text("x,y,z\n0,0,0")
    with pytest.raises(br.InputError, match="name another folder"):
        br.apply(result.folder, folder, points=folder / "points.csv", draws=2)
    assert (folder / "points.csv").read_text() == "x,y,z\n0,0,0"


def test_a_margin_holds_a_label_point_by_point(result, folder):
    inputs = {"labels": folder / "organ.nii.gz", "like": folder / "moving.nii.gz"}
    *_, path = br.apply(result.folder, folder / "margin", margins=[1], draws=20, **inputs)
    assert path.name == "organ_in-moving_margin95_label-1.vtk"
    surface = pyvista.read(path)
    share = br.load_image(folder / "margin" / "organ_in-moving_probability" / "label-1.nii.gz")
    assert surface.is_manifold
    voxels = share.voxel_volume * (np.asarray(share.voxels) > 0.05).sum()
    assert surface.volume == pytest.approx(voxels, rel=0.1)
    with pytest.raises(br.InputError, match="label 7, of which a margin is wanted"):
        br.apply(result.folder, folder / "margin", margins=[7], **inputs)
    with pytest.raises(br.InputError, match="give labels, too"):
        br.apply(result.folder, folder / "margin", points=folder / "pairs.csv", margins=[1])


def test_maps(result, folder):
    written = br.maps(result.folder, folder / "maps", far=(0.1, 2.0), draws=40)
    names = ["radius95", "p_over_0.1mm", "p_over_2mm", "jacobian_mean", "jacobian_sd", "p_inverted"]
    assert [path.name for path in written] == [f"{name}.nii.gz" for name in names]
    values = {name: np.asarray(nib.load(path).dataobj) for name, path in zip(names, written, strict=True)}
    sd = nib.load(result.folder / "displacement_sd.nii.gz")
    np.testing.assert_allclose(nib.load(written[0]).affine, sd.affine, atol=1e-6)
    total = np.sqrt((np.asarray(sd.dataobj)[..., 0, :] ** 2).sum(axis=-1))
    inside = total > 0
    np.testing.assert_array_equal(np.isfinite(values["radius95"]), inside)
    # √(χ² of one degree of freedom) … √(χ² of three): 1.96 … 1.61 times the root of the summed variances.
    ratio = values["radius95"][inside] / total[inside]
    assert 1.3 < np.quantile(ratio, 0.05) < np.quantile(ratio, 0.95) < 2.3
    assert (values["p_over_2mm"] <= values["p_over_0.1mm"])[inside].all()
    mesh = result.mesh
    u = result.u_mean
    ratio = (signed_volumes(mesh.points + u, mesh.cells) / mesh.volumes).min(), 3 * values["jacobian_sd"][inside].max()
    assert values["jacobian_mean"][inside].min() > ratio[0] - ratio[1]
    assert (values["p_inverted"][inside] == 0).all()
    away = np.eye(4)
    away[:3, 3] = 900.0
    br.save_image(br.Image(np.zeros((3, 3, 3)), away), folder / "far.nii.gz")
    with pytest.raises(br.InputError, match="no voxel of the grid"):
        br.maps(result.folder, folder / "maps", like=folder / "far.nii.gz")


def test_a_scene_for_slicer(result, folder):
    scene = slicer(result.folder, folder / "scene")
    root = ElementTree.parse(scene).getroot()
    nodes = {node.get("id"): node for node in root}
    assert len(nodes) == len(list(root))
    for node in root:
        if node.get("fileName"):
            assert (scene.parent / node.get("fileName")).is_file()
        for reference in filter(None, node.get("references", "").split(";")):
            assert reference.partition(":")[2] in nodes
    named = {node.get("name"): node for node in root}
    assert "transform:" in named["fixed"].get("references")
    assert "transform:" not in named["moving"].get("references")
    # Everything but what is carried lies in the moving image's world.
    moving, original = (nib.load(path) for path in (scene.parent / "moving.nii.gz", folder / "moving.nii.gz"))
    np.testing.assert_allclose(moving.affine, original.affine, atol=1e-4)
    places = br.read_point_pairs(scene.parent / "places.mrk.json", scene.parent / "places.mrk.json")
    predicted = result.run.predicted
    assert list(places.names) == list(predicted.place_names)
    u = predicted.place_draws.mean(axis=(0, 1))
    expected = result.run.matching.pose.place(predicted.place_points + u)
    np.testing.assert_allclose(places.fixed, expected, atol=0.05)
    ellipsoids = pyvista.read(scene.parent / "places_95.vtk")
    centres = [ellipsoids.points[ellipsoids["number"] == k].mean(axis=0) for k in range(len(places.names))]
    np.testing.assert_allclose(centres, places.fixed, atol=1e-3)
    surface = pyvista.read(scene.parent / "surface.vtk")
    assert surface.is_manifold
    assert (surface["radius95"] > 0).all()


def test_names_of_bids(result):
    place = result.folder / "bids" / "sub-01" / "ses-or" / "anat"
    stem = "sub-01_ses-or_"
    names = ["from-intraop_to-preop_mode-image_xfm.h5", "from-preop_to-intraop_mode-image_xfm.h5",
             "space-preop_desc-warped_T1w.nii.gz", "space-preop_stat-mean_displacement.nii.gz",
             "space-preop_stat-sd_displacement.nii.gz"]  # fmt: skip
    sidecars = [name.replace(".nii.gz", ".json").replace(".h5", ".json") for name in names]
    assert sorted(path.name for path in place.iterdir()) == sorted(stem + name for name in [*names, *sidecars])
    assert (place / (stem + names[0])).samefile(result.folder / "transform_mean.h5")
    description = json.loads((result.folder / "bids" / "dataset_description.json").read_text())
    assert description["DatasetType"] == "derivative"
    with pytest.raises(br.InputError, match=r"results.bids.subject"):
        make_config({"data": {"source": "mni152"}, "results": {"bids": {"subject": "sub_1"}}})


def test_draws_are_left_as_transforms(result):
    names = [path.name for path in sorted((result.folder / "transforms").iterdir())]
    assert names == [f"draw-{k}{end}" for k in range(1, 5) for end in (".h5", ".nii.gz", "_inverse.h5")]


def test_a_run_that_has_moved_is_carried_on_alone(applied, result, folder, tmp_path):
    """None of the files that it was made of is needed; nodes that were not sampled are solved for again."""
    shutil.copytree(result.folder, tmp_path / "copied")
    text = (tmp_path / "copied" / "config.yaml").read_text().replace(str(folder), "/gone")
    with RunFolder(tmp_path / "copied").writing() as place:
        place("config.yaml").write_text(text)
    assert len(result.mesh.interior) > 0
    br.apply(tmp_path / "copied", tmp_path / "there", points=folder / "p.csv", draws=40, far=(0.1, 2.0))
    assert (tmp_path / "there" / "points.csv").read_bytes() == (folder / "there" / "points.csv").read_bytes()


@pytest.mark.parametrize(("draws", "used"), [(None, 200), (300, 300)])
def test_labels_are_carried_by_as_many_draws_as_asked_for(result, folder, tmp_path, draws, used, caplog):
    caplog.set_level(logging.INFO)
    small = br.Image(np.zeros((4, 4, 4)), POSE.matrix @ MASK.affine @ np.diag([12.0, 12.0, 12.0, 1.0]))
    br.save_image(small, tmp_path / "small.nii.gz")
    # Points ask for more draws than labels do.
    inputs = {"points": folder / "p.csv", "labels": folder / "organ.nii.gz", "like": tmp_path / "small.nii.gz"}
    (folder / "p.csv").exists() or (folder / "p.csv").write_text("x,y,z\n0,0,0")
    br.apply(result.folder, tmp_path / "out", draws=draws, **inputs)
    assert any(line.startswith("labels of") and line.endswith(f"by {used} draws") for line in caplog.messages)
