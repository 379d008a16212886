"""Samplers compared on one configuration, from its file to the page."""

import csv
import json

import pytest
from typer.testing import CliRunner

import bayesreg as br
from bayesreg.cli import app
from bayesreg.config.samplers import sampler_section
from bayesreg.inference.samplers.registry import SAMPLERS
from bayesreg.workflow.compare_samplers import compare_samplers
from tests.test_pipeline import anatomy, folder  # noqa: F401


def test_every_sampler_has_a_section_whose_settings_it_takes():
    for name in SAMPLERS:
        assert sampler_section(name).name == name


@pytest.mark.slow
def test_a_comparison_from_a_file(folder, tmp_path):  # noqa: F811
    out = tmp_path / "compared"
    arguments = ("--samplers", "rwmh", "--minutes", "0.2", "--set", "stop.max_steps=60", "-q")
    done = CliRunner().invoke(app, ["compare-samplers", str(folder / "run.yaml"), "-o", str(out), *arguments])
    assert done.exit_code == 0, done.output
    assert f"Comparison: {out / 'samplers.html'}" in done.output
    (row,) = csv.DictReader((out / "samplers.csv").open())
    assert (row["sampler"], row["exact"]) == ("rwmh", "True")
    # Of the configuration: two chains, every third step kept; proposals outside the support are not evaluated.
    assert 0 < int(row["draws"]) < int(row["densities"]) <= 3 * int(row["draws"])
    assert json.loads((out / "samplers.json").read_text())["chains"] == 2
    with pytest.raises(br.InputError, match="already"):
        compare_samplers(folder / "run.yaml", out, ["rwmh"], progress=False)


def test_a_sampler_that_does_not_fit_is_a_note(folder, tmp_path):  # noqa: F811
    config = br.load_config(folder / "run.yaml", ["model.t_similarity={median: 0.05, log_sd: 0.5}"])
    (found,) = compare_samplers(config, tmp_path / "out", ["rwmh"], 0.1, progress=False)
    assert "no step for t_similarity" in found.note
    assert "rwmh did not run" in (tmp_path / "out" / "samplers.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--samplers", "hmc,gibbs"), "unknown sampler 'gibbs'; there are rwmh, hmc, nuts"),
        (("--samplers", "hmc,hmc"), "none of them twice; got hmc, hmc"),
        (("--minutes", "0"), "minutes must be positive, got 0"),
    ],
)
def test_wrong_options_are_one_message(folder, tmp_path, arguments, message):  # noqa: F811
    out = tmp_path / "never"
    done = CliRunner().invoke(app, ["compare-samplers", str(folder / "run.yaml"), "-o", str(out), *arguments])
    assert done.exit_code == 2
    assert done.stderr.startswith("bayesreg: ")
    assert message in done.stderr
    assert not out.exists()
