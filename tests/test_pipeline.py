"""The whole path on a phantom: run folder, resumption, comparison, and what a synthetic pair adds."""

import errno
import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import netCDF4
import nibabel as nib
import numpy as np
import pytest
import pyvista
import xarray as xr
from ruamel.yaml import YAML

import bayesreg as br
from bayesreg.fem.equilibrium import elastic_system
from bayesreg.fem.location import interpolation_at
from bayesreg.io import checkpoints, store
from bayesreg.io.datasets import Anatomy
from bayesreg.io.run_folder import RunFolder
from bayesreg.model import problem
from bayesreg.workflow import meshing, preparation
from bayesreg.workflow.assembly import posterior_of
from bayesreg.workflow.budget import block_length
from bayesreg.workflow.check import check
from bayesreg.workflow.reports import compare, report
from bayesreg.workflow.reproduce import reproduce
from bayesreg.workflow.simulate import simulate
from tests.phantoms import ball_mesh
from tests.reportless import without_reports

ROOT = Path(__file__).parent.parent
BAYESREG = (sys.executable, "-c", "from bayesreg.cli import main; main()")
CENTRE = np.array([5.0, -3.0, 8.0])
REGION = CENTRE + np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
STOP = {"rhat": 1.2, "ess": None, "max_steps": 36}
PROPER = "model.priors={lam: {high: 60}, mu: {high: 5}}"
SAMPLER = {"name": "rwmh", "chains": 2, "thin": 3, "block": 4, "sigma_u": 0.02}


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
        "model": {"preset": "paper"},
        "sampler": SAMPLER,
        "stop": STOP,
    }
    YAML(typ="safe").dump(config, folder / "run.yaml")
    return folder


@pytest.fixture
def no_report(finished):
    """Runs without their reports, whose pictures take longer than these runs; those of `finished` are looked at."""
    with without_reports():
        yield


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
    mesh = pyvista.read(out / "mesh.vtu")
    np.testing.assert_allclose(mesh.point_data["u_mean"], finished.u_mean)
    boundary = posterior.u_boundary.mean(("chain", "draw")).values
    np.testing.assert_allclose(finished.u_mean[finished.mesh.boundary], boundary, rtol=1e-4, atol=1e-6)
    field = nib.load(out / "displacement_mean.nii.gz")
    assert field.shape == (26, 26, 26, 1, 3)
    assert field.header.get_intent("code")[0] == 1007
    assert "Not converged" in (out / "report.html").read_text()
    assert not (out / "draws").exists()
    assert not (out / "metrics.json").exists()
    read = store.read_run(RunFolder(out)).predicted
    np.testing.assert_allclose(read.chain_mean.mean(axis=0), finished.u_mean, atol=1e-6)
    assert "Posterior predictive checks" in (out / "report.html").read_text()
    assert (out / "maps" / "support.nii.gz").is_file()
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


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize("cause", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_a_run_that_was_cut_off_resumes_to_the_same_draws(finished, folder, monkeypatch, cause):
    def cut_off(where, arrays):
        if arrays["blocks"] == 2:
            raise cause
        return save(where, arrays)

    save = checkpoints.save_state
    shutil.rmtree(folder / "cut", ignore_errors=True)
    monkeypatch.setattr(checkpoints, "save_state", cut_off)
    with pytest.raises(type(cause)):
        br.run(folder / "run.yaml", folder / "cut", progress=False)
    monkeypatch.undo()
    with pytest.raises(br.InputError, match="another configuration"):
        br.run(br.load_config(folder / "run.yaml", ["seed=4"]), folder / "cut", resume=True, progress=False)
    provenance = store.read_json(folder / "cut" / preparation.PROVENANCE)
    assert 0 < provenance["unsampled"] < 600
    with RunFolder(folder / "cut").writing() as place:
        store.write_json(place(preparation.PROVENANCE), provenance | {"unsampled": 3600})
    resumed = br.run(folder / "run.yaml", folder / "cut", resume=True, progress=False)
    timings = resumed.run.manifest["timings"]
    assert 3600 + timings["sampling"] < timings["total"] < 3600 + timings["sampling"] + 600
    # What the resumed run spent on getting ready counts, should it be cut off itself.
    assert store.read_json(folder / "cut" / preparation.PROVENANCE)["unsampled"] > 3600
    np.testing.assert_array_equal(resumed.idata.posterior.u_boundary, finished.idata.posterior.u_boundary)
    np.testing.assert_array_equal(resumed.u_sd, finished.u_sd)


@pytest.mark.usefixtures("no_report")
def test_a_finished_run_is_continued_with_more_draws(finished, folder):
    """The draws are those of a run that had the greater budget from the start."""
    more = br.load_config(folder / "run.yaml", [f"stop.max_steps={2 * STOP['max_steps']}"])
    uninterrupted = br.run(more, folder / "whole", progress=False)
    shutil.copytree(folder / "out", folder / "continued")
    continued = br.run(more, folder / "continued", resume=True, progress=False)
    assert continued.idata.posterior.sizes["draw"] == 2 * finished.idata.posterior.sizes["draw"]
    for group in ("posterior", "sample_stats"):
        dataset, expected = (getattr(run.idata, group) for run in (continued, uninterrupted))
        for name in expected:
            np.testing.assert_array_equal(dataset[name], expected[name])
    np.testing.assert_allclose(continued.u_sd, uninterrupted.u_sd, rtol=1e-12)
    assert f"max_steps: {2 * STOP['max_steps']}" in (folder / "continued" / "config.yaml").read_text()
    (folder / "continued" / "state.npz").unlink()
    with pytest.raises(br.InputError, match=r"holds no whole run: state\.npz is missing"):
        br.run(folder / "run.yaml", folder / "continued", resume=True, progress=False)
    assert (folder / "continued" / "run.json").exists()


@pytest.mark.usefixtures("no_report")
def test_a_finished_run_leaves_other_files_when_asked(finished, folder):
    shutil.copytree(folder / "out", folder / "others")
    config = br.load_config(folder / "run.yaml", ["results={draws: 3, bids: {subject: '01'}}"])
    result = br.run(config, folder / "others", resume=True, progress=False)
    np.testing.assert_array_equal(result.idata.posterior.u_boundary, finished.idata.posterior.u_boundary)
    np.testing.assert_allclose(result.u_sd, finished.u_sd, rtol=1e-5)
    assert len(list((folder / "others" / "transforms").glob("*.nii.gz"))) == 3
    assert not (folder / "out" / "transforms").exists()
    assert (folder / "others" / "bids" / "dataset_description.json").exists()
    with pytest.raises(br.InputError, match="only the sections stop, results, report, evaluation may change"):
        br.run(br.load_config(folder / "run.yaml", ["seed=4"]), folder / "others", resume=True, progress=False)


def test_a_run_whose_files_have_changed_is_told(finished, folder):
    """Also where it has ended; one that is gone, or whose content is the same, does not matter."""
    path = folder / "moving.nii.gz"
    content = path.read_bytes()
    try:
        br.save_image(br.load_image(folder / "fixed.nii.gz"), path)
        with pytest.raises(br.InputError, match=r"data\.moving \(.*moving\.nii\.gz\) has changed since the run in"):
            br.run(folder / "run.yaml", folder / "out", resume=True, progress=False)
    finally:
        path.write_bytes(content)
    assert br.run(folder / "run.yaml", folder / "out", resume=True, progress=False).folder == folder / "out"


def test_blocks_that_no_memory_holds_are_refused_before_any_draw(folder):
    config = br.load_config(folder / "run.yaml", ["sampler.block=100000000", "stop.max_steps=1000000000"])
    with pytest.raises(br.InputError, match=r"blocks of 100,000,000 draws .* GB, and this machine has"):
        br.run(config, folder / "too_much", progress=False)
    assert not (folder / "too_much").exists()


@pytest.mark.usefixtures("no_report")
def test_a_run_is_reproduced_bit_for_bit_and_another_is_told(finished, folder):
    # What it was made of may be gone.
    (folder / "moving.nii.gz").rename(folder / "gone.nii.gz")
    try:
        reproduction = reproduce(folder / "out", folder / "again", progress=False)
    finally:
        (folder / "gone.nii.gz").rename(folder / "moving.nii.gz")
    assert reproduction.same
    assert reproduction.lines == ["the draws are the same, bit for bit"]
    shutil.copytree(folder / "out", folder / "doubtful")
    with RunFolder(folder / "doubtful").writing() as place:
        shutil.copy(folder / "out" / "posterior.nc", place("posterior.nc"))
        with netCDF4.Dataset(place("posterior.nc"), "a") as file:
            file["posterior/u_boundary"][1, 3, 5, 0] += 1e-3
        manifest = store.read_json(folder / "out" / "run.json")
        manifest["versions"]["jax"] = "0.0.1"
        store.write_json(place("run.json"), manifest)
    reproduction = reproduce(folder / "doubtful", folder / "once_more", progress=False)
    assert list(reproduction.greatest_differences) == ["u_boundary"]
    assert reproduction.lines[0] == "the draws are not the same"
    assert "versions was" in reproduction.lines[-1]
    assert "0.0.1" in reproduction.lines[-1]


def test_a_start_field_for_another_mesh_is_told_before_the_pair_is_made(synthetic, folder, monkeypatch):
    monkeypatch.setattr(preparation, "simulate_pair", None)
    np.savez(folder / "other.npz", u=np.zeros((9, 3)))
    with pytest.raises(br.InputError, match=r"other\.npz has shape \(9, 3\); expected \(\d\d+, 3\)"):
        check(synthetic("paper", "start.field=other.npz"))


def test_nothing_is_written_where_a_chain_cannot_start(folder):
    far = np.full((len(br.load_mesh(folder / "mesh.vtu").points), 3), np.nan)
    np.savez(folder / "far.npz", u=far)
    config = br.load_config(folder / "run.yaml", ["start.field=far.npz", "start.fraction=1"])
    with pytest.raises(br.InputError, match=r"far\.npz"):
        br.run(config, folder / "never", progress=False)
    assert not (folder / "never").exists()


@pytest.mark.parametrize(
    ("overrides", "lam", "mu"),
    [
        ([], [0.01, 10, 10], [0.01, 1, 1]),
        (["start.lam=7"], [7, 7, 7], [0.01, 1, 1]),
        (["start.mu={csf: 0.2, gm: 3, wm: 4}"], [0.01, 10, 10], [0.2, 1, 4]),  # μ of GM is known to be 1.
        (["start.lam=7", "model.elasticity=uniform"], [7], [1]),
    ],
)
def test_the_posterior_is_built_once_at_the_start_parameters(finished, folder, monkeypatch, overrides, lam, mu):
    built = []
    monkeypatch.setattr(problem, "elastic_system", lambda *args: built.append(args) or elastic_system(*args))
    posterior = posterior_of(
        br.load_config(folder / "run.yaml", overrides), store.read_inputs(RunFolder(folder / "out"))
    )
    assert len(built) == 1
    np.testing.assert_allclose(posterior.reference()["lam"], lam)
    np.testing.assert_allclose(posterior.reference()["mu"], mu)


@pytest.mark.parametrize(("points", "draws"), [(900, 100), (16_000, 100), (96_000, 20), (2_000_000, 10)])
def test_looks_at_the_stop_rule_keep_up_with_the_size_of_a_problem(finished, folder, points, draws):
    posterior = posterior_of(br.load_config(folder / "run.yaml"), store.read_inputs(RunFolder(folder / "out")))
    larger = posterior.images._replace(positions=np.ones((points, 3)))
    assert block_length(replace(posterior, data=posterior.data.with_term("images", larger))) == draws
    assert block_length(replace(posterior, data=posterior.data.without_term("images"))) == 100


def test_check_estimates_without_writing(folder):
    text = check(folder / "run.yaml").text
    assert "steps per second" in text
    assert "MB on the device" in text


@pytest.mark.long
def test_uniform_beside_tissues(finished, folder):
    uniform = br.load_config(folder / "run.yaml", ["model.elasticity=uniform"])
    result = br.run(uniform, folder / "uniform", progress=False)
    assert result.idata.posterior.sizes["tissue"] == 1
    page = compare([folder / "out", folder / "uniform"], folder / "compare.html").read_text()
    assert "Uniform" in page
    assert "By tissue" in page
    assert report(folder / "uniform").stat().st_size > 100_000


@pytest.fixture
def synthetic(folder, anatomy, monkeypatch):
    monkeypatch.setattr(preparation, "mni152", lambda: anatomy)
    monkeypatch.setattr(meshing, "build_mesh", lambda *_: ball_mesh(radius=38, spacing=15))

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


@pytest.mark.usefixtures("no_report")
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


@pytest.mark.slow
@pytest.mark.long
def test_elastography_samples_the_elastic_parameters_alone(synthetic, folder):
    out = folder / "elastography"
    overrides = ["known_boundary=truth", PROPER, "start.field=identity"]
    overrides += ["sampler.sigma_lam=0.5", "sampler.sigma_mu=0.05"]
    result = br.run(synthetic("paper", *overrides), out, progress=False)
    posterior, truth = result.idata.posterior, result.run.truth
    assert posterior.u_boundary.shape == (2, 12, 0, 3)
    assert posterior["lam"].values.std(axis=(0, 1)).min() > 0
    boundary = result.mesh.boundary
    np.testing.assert_allclose(result.u_mean[boundary], truth.u[boundary], rtol=1e-12)
    assert result.metrics["boundary_error"]["posterior_mean"]["max"] < 1e-9
    assert result.metrics["coverage"] == {}
    page = result.report.read_text()
    assert "Elastography: posterior of the elastic parameters" in page
    assert "one node at the skull" not in page
    np.testing.assert_array_equal(store.read_inputs(RunFolder(out)).boundary, truth.u[boundary])


@pytest.mark.slow
@pytest.mark.long
def test_the_example_of_the_readme_runs_word_for_word(anatomy, tmp_path, monkeypatch, capsys):
    """On a phantom in place of MNI152, from a quickstart made small, with a field of stiffness, which is mapped."""
    code, of_points = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    monkeypatch.setattr(preparation, "mni152", lambda: anatomy)
    monkeypatch.setattr(meshing, "build_mesh", lambda *_: ball_mesh(radius=38, spacing=24))
    monkeypatch.chdir(tmp_path)
    small = {
        "simulate": {"displacement": 3, "patch_nodes": 4},
        "model": {"elasticity": "field", "field": {"modes": 8, "correlation": 40}},
        "sampler": {"warm_up": 5, "block": 10},
        "stop": {"max_steps": 20},
    }
    (tmp_path / "configs").mkdir()
    extended = {"extends": str(ROOT / "configs" / "quickstart.yaml"), **small}
    YAML(typ="safe").dump(extended, tmp_path / "configs" / "quickstart.yaml")
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    text = capsys.readouterr().out
    assert "converged: False" in text
    assert [line.split()[0] for line in text.splitlines() if re.match(r"(csf|gm|wm) +\d", line)] == ["csf", "gm", "wm"]
    assert len(text.splitlines()[-1].strip("[]").split()) == 3
    out = tmp_path / "runs" / "example"
    assert "Stiffness within the tissues" in (out / "report.html").read_text()
    cells = pyvista.read(out / "mesh.vtu").cell_data
    mean, sd, stiffer = (np.asarray(cells[name]) for name in ("stiffness_mean", "stiffness_sd", "stiffer_probability"))
    assert mean.min() > 0
    assert sd.min() > 0
    assert 0 <= stiffer.min() <= stiffer.max() <= 1
    places = CENTRE + np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
    rows = np.hstack([places, places + np.array([2.0, 0.0, 0.0])])
    header = "fixed_x,fixed_y,fixed_z,moving_x,moving_y,moving_z"
    np.savetxt(tmp_path / "points.csv", rows, delimiter=",", header=header, comments="")
    exec(compile(of_points, "README.md", "exec"), names)
    assert names["draws"].u_mean[:, 0].mean() == pytest.approx(2.0, abs=0.8)


@pytest.mark.usefixtures("no_report")
def test_simulate_writes_the_pair(synthetic, folder):
    out = simulate(synthetic("paper"), folder / "simulated")
    inputs = store.read_inputs(RunFolder(out))
    assert inputs.truth is not None
    assert inputs.moving.shape == inputs.fixed.shape
    assert json.loads((out / "inputs" / "provenance.json").read_text())["pair"]["residual_sd_at_truth"] > 0
    begun = br.run(synthetic("paper"), out, resume=True, progress=False)
    np.testing.assert_allclose(begun.run.truth.initial, 0.5 * inputs.truth.u)


class MeanDisplacement:
    """An observation from outside the package: the mean displacement of a region was measured, mm."""

    name = "region"

    def __init__(self, shift=4.0):
        self.shift = np.array([0.0, shift, 0.0])

    def standardised_residual(self, state):
        return (state.at(REGION).mean(axis=0) - self.shift) / 0.01

    def log(self, state):
        z = self.standardised_residual(state)
        return -0.5 * (z @ z)


@pytest.mark.slow
@pytest.mark.long
def test_an_observation_from_outside_goes_through_run_resume_and_report(folder, tmp_path):
    def config(steps):
        settings = [
            "sampler={name: laplace, chains: 2}",
            f"stop={{rhat: 1.01, ess: null, max_steps: {steps}}}",
        ]
        return br.load_config(folder / "run.yaml", [*settings, "observations.0.interpolation=cubic"])

    out, observed = tmp_path / "out", [MeanDisplacement()]
    with without_reports():
        br.run(config(10), out, progress=False, observations=observed)
    with pytest.raises(br.InputError, match="began with the observations \\['region'\\] besides those of its config"):
        br.run(config(30), out, resume=True, progress=False)
    with pytest.raises(br.InputError, match="began with another observation 'region' than it is resumed with"):
        br.run(config(30), out, resume=True, progress=False, observations=[MeanDisplacement(3.0)])
    result = br.run(config(30), out, resume=True, progress=False, observations=observed)
    u = result.idata.posterior["u_boundary"]
    assert u.sizes["draw"] == 30
    # Without it the region moves by 0.8 mm, as the images do.
    nodes, weights = interpolation_at(result.mesh, REGION)
    moved = np.einsum("ka,kai->i", weights, result.u_mean[nodes]) / len(REGION)
    np.testing.assert_allclose(moved, [0, 4, 0], atol=0.1)
    descriptions = json.loads((out / "run.json").read_text())["observations"]
    assert [descriptions[name]["kind"] for name in ("images", "region")] == ["images", "own"]
    assert descriptions["region"]["residual_rms"] < 10
    page = result.report.read_text(encoding="utf-8")
    assert "an observation of your own" in page
    assert "+ log p(region | <var>u</var>)" in page
