"""The whole path on a phantom: run folder, resumption, comparison, and what a synthetic pair adds."""

import errno
import json
import shutil

import meshio
import nibabel as nib
import numpy as np
import pytest
import xarray as xr
from ruamel.yaml import YAML

import bayesreg as br
from bayesreg import pipeline, preparation
from bayesreg.io import store
from bayesreg.io.datasets import Anatomy
from tests.phantoms import ball_mesh

CENTRE = np.array([5.0, -3.0, 8.0])
STOP = {"rhat": 1.2, "max_steps": 36}
SAMPLER = {"chains": 2, "thin": 3, "block": 4, "sigma_u": 0.02}


@pytest.fixture(scope="module")
def anatomy():
    affine = np.diag([-4.0, 4.0, 4.0, 1.0])  # Left-handed.
    affine[:3, 3] = CENTRE + np.array([50.0, -50.0, -50.0])
    grid = br.Image(np.zeros((26, 26, 26)), affine)
    radius = np.linalg.norm(grid.grid_points() - CENTRE, axis=-1)
    labels = np.select([radius < 14, radius < 28, radius < 41], [1, 3, 2], 0)
    noise = np.random.default_rng(0).normal(size=grid.shape)
    image = 100 + 400 * np.array([0.05, 0.2, 0.5, 0.8])[labels] + 20 * noise * (labels > 0)
    return Anatomy(
        grid.with_voxels(image),
        grid.with_voxels(labels.astype(np.int8)),
        grid.with_voxels((radius < 46).astype(np.uint8)),
    )


@pytest.fixture(scope="module")
def folder(anatomy, tmp_path_factory):
    """A folder with the files of a pair and `run.yaml`."""
    folder = tmp_path_factory.mktemp("pair")
    moved = anatomy.image.interpolate(anatomy.image.grid_points() + np.array([0.0, 0.8, 0.0]))
    br.save_image(anatomy.image, folder / "fixed.nii.gz")
    br.save_image(anatomy.image.with_voxels(np.asarray(moved)), folder / "moving.nii.gz")
    br.save_image(anatomy.tissue, folder / "labels.nii.gz")
    br.save_image(anatomy.intracranial, folder / "intracranial.nii.gz")
    br.save_mesh(ball_mesh(radius=38), folder / "mesh.vtu")
    files = {name: f"{name}.nii.gz" for name in ("fixed", "moving", "labels", "intracranial")}
    config = {
        "seed": 3,
        "data": {"source": "files", **files, "label_table": {"csf": [1], "gm": [2], "wm": [3]}},
        "mesh": {"file": "mesh.vtu"},
        "sampler": SAMPLER,
        "stop": STOP,
    }
    YAML(typ="safe").dump(config, folder / "run.yaml")
    return folder


@pytest.fixture(scope="module")
def finished(folder):
    return br.run(folder / "run.yaml", folder / "out", progress=False)


def test_the_run_folder_is_that_of_the_contract(finished, folder):
    out = folder / "out"
    posterior = xr.open_dataset(out / "posterior.nc", group="posterior")
    assert posterior.u_boundary.sizes == {"chain": 2, "draw": 12, "node": len(finished.mesh.boundary), "axis": 3}
    assert list(posterior.tissue.values) == ["csf", "gm", "wm"]
    manifest = json.loads((out / "run.json").read_text())
    assert manifest["seed"] == 3
    assert manifest["exact"] is True
    assert manifest["stopped"]["converged"] is False
    assert manifest["mesh_digest"] == br.load_mesh(folder / "mesh.vtu").digest
    assert manifest["convergence"]["rhat_max"] > 1.2
    assert 0 < manifest["acceptance"]["overall"] <= manifest["acceptance"]["inside_support"] <= 1
    mesh = meshio.read(out / "mesh.vtu")
    np.testing.assert_allclose(mesh.point_data["u_mean"], finished.u_mean)
    boundary = posterior.u_boundary.mean(("chain", "draw")).values
    np.testing.assert_allclose(finished.u_mean[finished.mesh.boundary], boundary, rtol=1e-4, atol=1e-6)
    field = nib.load(out / "displacement_mean.nii.gz")
    assert field.shape == (26, 26, 26, 1, 3)
    assert field.header.get_intent("code")[0] == 1007
    assert "Not converged" in (out / "report.html").read_text()
    assert not (out / "draws").exists()
    assert not (out / "metrics.json").exists()
    read = store.read_run(out).predicted
    np.testing.assert_allclose(read.chain_mean.mean(axis=0), finished.u_mean, atol=1e-6)
    assert "Posterior predictive checks" in (out / "report.html").read_text()
    assert not finished.converged


def test_intensities_share_one_robust_scale(finished):
    inside = finished.run.tissue.voxels > 0
    assert np.quantile(finished.run.fixed.voxels[inside], [0.005, 0.995]) == pytest.approx([0, 1], abs=1e-3)
    assert np.median(finished.run.moving.voxels[inside]) == pytest.approx(
        np.median(finished.run.fixed.voxels[inside]), abs=0.05
    )


def test_a_folder_that_holds_a_run_is_left_alone(finished, folder):
    before = (folder / "out" / "run.json").read_text()
    with pytest.raises(br.InputError, match="already holds a run"):
        br.run(folder / "run.yaml", folder / "out", progress=False)
    again = br.run(folder / "run.yaml", folder / "out", resume=True, progress=False)
    assert (folder / "out" / "run.json").read_text() == before
    np.testing.assert_array_equal(again.u_mean, br.load_result(folder / "out").u_mean)


@pytest.mark.parametrize("cause", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_a_run_that_was_cut_off_resumes_to_the_same_draws(finished, folder, monkeypatch, cause):
    def cut_off(where, arrays):
        if arrays["blocks"] == 2:
            raise cause
        return save(where, arrays)

    save = store.save_state
    shutil.rmtree(folder / "cut", ignore_errors=True)
    monkeypatch.setattr(store, "save_state", cut_off)
    with pytest.raises(type(cause)):
        br.run(folder / "run.yaml", folder / "cut", progress=False)
    monkeypatch.undo()
    with pytest.raises(br.InputError, match="another configuration"):
        br.run(br.load_config(folder / "run.yaml", ["seed=4"]), folder / "cut", resume=True, progress=False)
    resumed = br.run(folder / "run.yaml", folder / "cut", resume=True, progress=False)
    np.testing.assert_array_equal(resumed.idata.posterior.u_boundary, finished.idata.posterior.u_boundary)
    np.testing.assert_array_equal(resumed.u_sd, finished.u_sd)


def test_nothing_is_written_where_a_chain_cannot_start(folder):
    far = np.full((len(br.load_mesh(folder / "mesh.vtu").points), 3), np.nan)
    np.savez(folder / "far.npz", u=far)
    config = br.load_config(folder / "run.yaml", ["start.field=far.npz", "start.fraction=1"])
    with pytest.raises(br.InputError, match=r"far\.npz"):
        br.run(config, folder / "never", progress=False)
    assert not (folder / "never").exists()


def test_check_estimates_without_writing(folder):
    text = pipeline.check(folder / "run.yaml").text
    assert "steps per second" in text
    assert "MB on the device" in text


def test_uniform_beside_tissues(finished, folder):
    uniform = br.load_config(folder / "run.yaml", ["model.elasticity=uniform"])
    result = br.run(uniform, folder / "uniform", progress=False)
    assert result.idata.posterior.sizes["tissue"] == 1
    page = pipeline.compare([folder / "out", folder / "uniform"], folder / "compare.html").read_text()
    assert "Uniform" in page
    assert "By tissue" in page
    report = pipeline.report(folder / "uniform")
    assert report.stat().st_size > 100_000


@pytest.fixture
def synthetic(folder, anatomy, monkeypatch):
    monkeypatch.setattr(preparation, "mni152", lambda: anatomy)
    monkeypatch.setattr(preparation, "build_mesh", lambda *_: ball_mesh(radius=38, spacing=15))

    def config(kind, *overrides):
        content = {
            "data": {"source": "mni152"},
            "simulate": {"kind": kind, "displacement": 3, "patch_nodes": 4},
            "mesh": {"file": str(folder / "mesh.vtu")},
            "sampler": SAMPLER,
            "start": {"field": "truth", "fraction": [0.4, 0.6]},
            "stop": STOP,
        }
        YAML(typ="safe").dump(content, folder / f"{kind}.yaml")
        return br.load_config(folder / f"{kind}.yaml", overrides)

    return config


@pytest.mark.parametrize("kind", ["paper", "calibrated"])
def test_a_synthetic_pair_brings_its_truth(synthetic, folder, kind):
    result = br.run(synthetic(kind), folder / kind, progress=False)
    truth = result.run.truth
    np.testing.assert_array_equal(truth.lam, [1e-6, 10, 30])
    np.testing.assert_allclose(truth.initial, 0.5 * truth.u)
    pair = result.run.manifest["pair"]
    if kind == "paper":
        np.testing.assert_allclose(np.linalg.norm(truth.u[pair["patch"]], axis=1), 3)
    assert pair["kind"] == kind
    assert pair["noise_sd"] == (0.003 if kind == "paper" else 0.01)
    metrics = result.metrics["boundary_error"]
    half = np.linalg.norm(0.5 * truth.u[result.mesh.boundary], axis=1)
    assert metrics["initial"]["median"] == pytest.approx(np.median(half))
    assert metrics["posterior_mean"]["median"] < 2 * metrics["initial"]["median"]


def test_simulate_writes_the_pair(synthetic, folder):
    out = pipeline.simulate(synthetic("paper"), folder / "simulated")
    inputs = store.read_inputs(out)
    assert inputs.truth is not None
    assert inputs.moving.shape == inputs.fixed.shape
    assert json.loads((out / "inputs" / "provenance.json").read_text())["pair"]["residual_sd_at_truth"] > 0
