"""Samplers compared on one configuration, from its file to the table."""

import json

import pytest

import bayesreg as br
from bayesreg.config.samplers import sampler_section
from bayesreg.inference.samplers.registry import SAMPLERS
from studies.compare_samplers.__main__ import compare_samplers, main
from tests.test_pipeline import anatomy, folder  # noqa: F401


def test_every_sampler_has_a_section_whose_settings_it_takes():
    for name in SAMPLERS:
        assert sampler_section(name).name == name


@pytest.mark.long
def test_a_comparison_from_a_file(folder, tmp_path, monkeypatch, capsys):  # noqa: F811
    out = tmp_path / "compared"
    options = ("--samplers", "rwmh", "--minutes", "0.2", "--set", "stop.max_steps=60")
    monkeypatch.setattr("sys.argv", ["compare_samplers", str(folder / "run.yaml"), "-o", str(out), *options])
    main()
    assert "rwmh" in capsys.readouterr().out
    stored = json.loads((out / "samplers.json").read_text())
    (row,) = stored["samplers"]
    assert (row["sampler"], row["exact"]) == ("rwmh", True)
    # Of the configuration: two chains, every third step kept; proposals outside the support are not evaluated.
    assert 0 < row["draws"] < row["densities"] <= 3 * row["draws"]
    assert stored["chains"] == 2
    with pytest.raises(br.InputError, match="already"):
        compare_samplers(folder / "run.yaml", out, ["rwmh"], progress=False)


INFERRED = "{kind: ssd, temperature: {median: 0.05, log_sd: 0.5}}"


def test_a_sampler_that_does_not_fit_is_a_note(folder, tmp_path):  # noqa: F811
    config = br.load_config(folder / "run.yaml", [f"observations=[{{kind: images, similarity: {INFERRED}}}]"])
    (efficiency,) = compare_samplers(config, tmp_path / "out", ["rwmh"], 0.1, progress=False)
    assert "no step for t_similarity" in efficiency.note
    assert "no step for t_similarity" in (tmp_path / "out" / "samplers.json").read_text()


@pytest.mark.parametrize(
    ("samplers", "minutes", "message"),
    [
        (["hmc", "mala"], 5.0, "unknown sampler 'mala'; there are rwmh, hmc, nuts"),
        (["hmc", "hmc"], 5.0, "none of them twice; got hmc, hmc"),
        (["hmc"], 0.0, "minutes must be positive, got 0"),
    ],
)
def test_wrong_options_are_one_message(folder, tmp_path, samplers, minutes, message):  # noqa: F811
    with pytest.raises(br.InputError, match=message):
        compare_samplers(folder / "run.yaml", tmp_path / "never", samplers, minutes)
    assert not (tmp_path / "never").exists()
