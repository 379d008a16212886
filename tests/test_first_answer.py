"""The first answer of a run: before the first draw, and near what the draws say later."""

import numpy as np
import pytest
import pyvista

import bayesreg as br
from bayesreg.inference.gaussian import about_gaussian
from bayesreg.io.run_folder import RunFolder
from bayesreg.workflow import beginning
from tests.reportless import without_reports
from tests.test_observations import IMAGES, PAIRS, configuration, folder  # noqa: F401

FILES = ("displacement_mean.nii.gz", "displacement_sd.nii.gz", "transform_mean.h5", "transform_mean_inverse.h5")


def run_until_the_answer(config, out):
    """Run as if Ctrl-C had come just after the first answer."""
    write = beginning.write_first_answer

    def write_and_stop(*arguments):
        write(*arguments)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(beginning, "write_first_answer", write_and_stop)
        with pytest.raises(KeyboardInterrupt):
            br.run(config, out, progress=False)
    assert RunFolder(out).stage == "prepared"
    assert not (out / "draws").exists()
    assert "The run goes on." in (out / "report.html").read_text(encoding="utf-8")
    assert all(RunFolder(out).is_sound(name) for name in (*FILES, "report.html", "mesh.vtu"))


def test_the_draws_replace_it(folder, tmp_path):  # noqa: F811
    """A run that was stopped just after it goes on with --resume."""
    out = tmp_path / "out"
    stop = {"rhat": None, "ess": None, "max_steps": 200}
    labels = {name: IMAGES[name] for name in ("labels", "label_table")}
    config = configuration(folder, [PAIRS], labels, stop=stop, sampler={"name": "hmc", "chains": 4})
    run_until_the_answer(config, out)
    nodes = pyvista.read(out / "mesh.vtu").point_data
    first_mean, first_sd = np.array(nodes["u_mean"]), np.array(nodes["u_sd"])
    result = br.run(config, out, resume=True, progress=False)
    assert RunFolder(out).stage == "finished"
    assert "The run goes on." not in result.report.read_text(encoding="utf-8")
    # Points of known sd make a Gaussian posterior: 800 draws against 400 independent ones of the same Gaussian.
    assert np.median(np.abs(result.u_mean - first_mean) / result.u_sd) < 0.15
    np.testing.assert_allclose(np.median(first_sd / result.u_sd), 1.0, atol=0.1)


@pytest.mark.long
def test_a_run_that_goes_on_after_it_draws_as_if_nothing_had_happened(folder, tmp_path):  # noqa: F811
    """The search begins again: from the untempered posterior, if the default model asks for it."""
    images = {"kind": "images", "most_points": 2000}
    stop = {"rhat": None, "ess": None, "max_steps": 2}
    config = configuration(folder, [images], IMAGES, model=None, sampler={"warm_up": 4}, stop=stop)
    with without_reports():
        whole = br.run(config, tmp_path / "whole", progress=False)
        run_until_the_answer(config, tmp_path / "out")
        assert RunFolder(tmp_path / "out").is_sound("warped_mean.nii.gz")
        result = br.run(config, tmp_path / "out", resume=True, progress=False)
    np.testing.assert_array_equal(result.idata.posterior["u_boundary"], whole.idata.posterior["u_boundary"])
    total = result.run.manifest["timings"]
    assert total["total"] > total["sampling"] > 0


def test_an_approximate_sampler_has_none(folder, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr(beginning, "write_first_answer", lambda *_: pytest.fail("a first answer was written"))
    br.run(configuration(folder, [PAIRS], stop={"rhat": None, "max_steps": 4}), tmp_path / "out", progress=False)


def test_a_warm_up_that_fails_leaves_no_run(folder, tmp_path, monkeypatch):  # noqa: F811
    """A mended configuration then runs in the same folder."""
    out = tmp_path / "out"
    config = configuration(folder, [PAIRS], stop={"rhat": None, "max_steps": 4}, sampler={"name": "hmc", "chains": 2})
    written = []
    monkeypatch.setattr(beginning, "write_first_answer", lambda *_: written.append(RunFolder(out).stage))

    def fail(*_):
        raise br.InputError("no step is short enough")

    monkeypatch.setattr(about_gaussian, "_warm_up", fail)
    with pytest.raises(br.InputError, match="short enough"):
        br.run(config, out, progress=False)
    assert written == ["prepared"]
    RunFolder(out).require_fresh()
