"""Configurations: what is accepted, what is refused and in which words."""

import math
from pathlib import Path

import pytest
from pydantic import ValidationError

from bayesreg.config import Config, ConfigError, load_config, model_of, resolved_yaml, schema
from bayesreg.model.observations.images.options import ImageOptions, with_preset
from bayesreg.model.options import ModelConfig
from bayesreg.settings import ScalePrior
from bayesreg.types import InputError

CONFIGS = Path(__file__).parent.parent / "configs"
SMALL = "data: {source: mni152}\nsimulate: {kind: paper}\n"
POINTS = "observations: [{kind: landmarks, file: points.csv}]"
PRIORS = "priors: {lam: {csf: {high: 9}, gm: {high: 9}, wm: {high: 9}}, mu: {high: 9}}"
PROPER = f"model: {{{PRIORS}, elastic_prior: {{kind: boltzmann, normalised: true"
FILES = """
data:
  source: files
  fixed: fixed.nii
  moving: moving.nii
  labels: labels.nii
  label_table: {csf: [1, 8], gm: 2, wm: [3]}
"""


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Write a configuration into a folder with three files; the current folder is another one."""
    folder = tmp_path / "configs"
    for place in ("configs", "here", "data"):
        (tmp_path / place).mkdir()
    for name in ("fixed.nii", "moving.nii", "labels.nii"):
        (folder / name).touch()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.delenv("BAYESREG_DATA", raising=False)

    def _write(text: str, name: str = "run.yaml") -> Path:
        (folder / name).write_text(text, encoding="utf-8")
        return folder / name

    return _write


@pytest.fixture
def paper_data(tmp_path, monkeypatch):
    """A folder with files that bear the names of the paper's data."""
    for name in ("brainweb_crisp_1mm.nii.gz", "colin27_t1_1mm_unedited.nii.gz"):
        (tmp_path / name).touch()
    monkeypatch.setenv("BAYESREG_DATA", str(tmp_path))
    return tmp_path


def complaint(path: Path, *overrides: str) -> str:
    """What is said of a configuration that cannot be run."""
    with pytest.raises(ConfigError) as caught:
        load_config(path, overrides)
    return str(caught.value)


def test_quickstart_is_the_papers_pair_on_mni152_within_a_budget():
    config = load_config(CONFIGS / "quickstart.yaml")
    assert (config.data.source, config.simulate.kind) == ("mni152", "paper")
    assert config.stop.max_minutes <= 7


def test_paper_tissues_is_section_4_2_to_the_letter(paper_data):
    config = load_config(CONFIGS / "paper_tissues.yaml")
    assert config.data.t1 == paper_data / "colin27_t1_1mm_unedited.nii.gz"
    assert (config.simulate.displacement, config.simulate.patch_nodes) == (15, 20)
    assert config.simulate.lam == {"csf": 1e-6, "gm": 10, "wm": 30}
    assert config.simulate.mu == {"csf": 1e-6, "gm": 1, "wm": 1}
    elastic, (images,) = config.model.elastic_prior, config.observations
    assert (config.model.elasticity, elastic.kind, elastic.temperature) == ("tissue", "boltzmann", 10_000)
    assert (elastic.nodes, elastic.normalised, config.model.skull_width) == ("boundary", False, 0)
    assert (images.similarity.kind, images.similarity.temperature, images.quadrature) == ("ssd", 0.05, "gauss4")
    assert (config.model.fixed, config.model.priors) == ({"mu": {"gm": 1.0}}, {})
    assert (config.sampler.name, config.sampler.sigma_u) == ("rwmh", 0.008)
    assert (config.sampler.chains, config.sampler.thin) == (3, 10)
    assert (config.stop.rhat, config.stop.ess, config.stop.max_steps, config.stop.max_minutes) == (
        1.2,
        None,
        250_000,
        None,
    )


def test_paper_uniform_differs_in_the_elasticity_alone(paper_data):
    tissues, uniform = (load_config(CONFIGS / f"paper_{name}.yaml").model_dump() for name in ("tissues", "uniform"))
    assert uniform["model"].pop("elasticity") == "uniform"
    assert uniform["model"].pop("fixed") == {"mu": 1.0}
    for config in (tissues, uniform):
        config["model"].pop("elasticity", None), config["model"].pop("fixed", None), config.pop("description")
    assert uniform == tissues


def test_resolved_configuration_reads_back_the_same(write):
    text = """
seed: 7
data: {source: mni152}
simulate: {kind: calibrated, direction: [1, 2, 3], lam: {csf: 1e-6, gm: 10, wm: 3e1}}
model:
  elastic_prior: {held: {12: [0, 0, -1.5]}, nodes: [1, 2, 3]}
  priors: {lam: {gm: {alpha: 2, beta: 3, low: 0, high: 60}, wm: {median: 9, log_sd: 0.5}}, mu: {high: .inf}}
start: {field: truth, fraction: 0.5, lam: {csf: 1, gm: 10, wm: 20}}
stop: {rhat: null, max_minutes: 1}
report: {places: {left ventricle: [-12, 3.5, 20]}}
"""
    config = load_config(write(text))
    assert config.report.places == {"left ventricle": (-12.0, 3.5, 20.0)}
    assert load_config(write(resolved_yaml(config), "resolved.yaml")) == config
    assert config.start.fraction == (0.5, 0.5)
    assert config.model.priors["mu"].high == math.inf
    assert config.model.priors["lam"]["wm"] == ScalePrior(median=9.0, log_sd=0.5)
    assert math.hypot(*config.simulate.direction) == pytest.approx(1)
    assert "max_minutes: 1.0" in resolved_yaml(config)
    assert "rhat: null" in resolved_yaml(config)


@pytest.mark.parametrize("more", ["", ", temperature: {median: 200}", "}, fixed: {", ", held: {3: [0, 0, 0]}"])
@pytest.mark.parametrize("kind", ["ssd", "student_t"])
def test_the_proper_density(write, more, kind):
    similarity = f"{{kind: {kind}, temperature: {{median: 0.05, log_sd: 0.5}}}}"
    observed = f"\nobservations: [{{kind: images, similarity: {similarity}}}]"
    config = load_config(write(SMALL + PROPER + more + "}}" + observed))
    (images,) = config.observations
    assert (images.similarity.temperature.median, images.similarity.temperature.log_sd) == (0.05, 0.5)
    assert load_config(write(resolved_yaml(config), "resolved.yaml")) == config


def test_numbers_and_words_are_read_as_in_yaml_1_2(write):
    config = load_config(write(SMALL + "mesh: {edge_length: 2e1, envelope: 1e-3}\ndescription: no\n"))
    assert (config.mesh.edge_length, config.mesh.envelope, config.description) == (20.0, 0.001, "no")


def test_files_of_ones_own(write):
    config = load_config(write(FILES))
    assert config.data.label_table == {"csf": (1, 8), "gm": (2,), "wm": (3,)}
    assert config.data.intracranial is None
    assert config.simulate is None


def test_a_configuration_cannot_be_changed(write):
    config = load_config(write(SMALL))
    with pytest.raises(ValidationError, match="frozen"):
        config.sampler.chains = 5


def test_every_error_is_named_at_once_with_its_line_and_value(write):
    text = """
seed: -1
data:
  source: files
  fixed: fixed.nii
  moving: gone.nii
  labls: labels.nii
  label_table: {csf: 1, gm: [1, 2], wm: 3}
sampler:
  chainz: 4
  thin: 2.5
stop: {rhat: "low", max_steps: 0}
start: {field: truth}
"""
    message = complaint(write(text), "model.rigid_sd=-3")
    for error in (
        "run.yaml:2: seed = -1: expected greater than or equal to 0",
        'run.yaml:6: data.moving = "gone.nii": no such file',
        "run.yaml:7: data.labls",
        "did you mean labels?",
        "label 1 belongs to csf already, and cannot belong to gm",
        "run.yaml:10: sampler.chainz = 4: unknown key; did you mean chains?",
        "run.yaml:11: sampler.thin = 2.5: expected a whole number",
        'run.yaml:12: stop.rhat = "low": expected a number',
        "run.yaml:12: stop.max_steps = 0: expected greater than or equal to 1",
        "--set model.rigid_sd=-3: model.rigid_sd = -3: expected greater than 0",
        'run.yaml:13: start.field = "truth": the truth of this pair is not known',
    ):
        assert error in message
    assert len(message.splitlines()) == 11


def similar(settings):
    return f"observations: [{{kind: images, similarity: {{{settings}}}}}]"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "data: missing"),
        ("[1, 2]", "expected keys with values"),
        ("seed: 1\nseed: 2\n" + SMALL, "line 2: not valid YAML: found duplicate key"),
        ("seed: [1\ndata: 2", "line 2: not valid YAML"),
        ("seed: !!python/object 1", "tags such as"),
        ("data: {}", "data.source: missing"),
        ("data: {source: mars}", "data.source = \"mars\": expected one of 'mni152', 'brainweb', 'files'"),
        ("data: 3", "data = 3: expected keys with values"),
        ("data: {source: mni152}", "simulate: missing: data.source is mni152"),
        (FILES + "simulate: {kind: paper}", 'simulate = {"kind": "paper"}: expected null'),
        (SMALL + "colour: red", 'colour = "red": unknown key; known are description, seed, data'),
        (SMALL + "seed: true", "seed = true: expected a whole number"),
        (SMALL + "mesh: {edge_length: '18'}", 'mesh.edge_length = "18": expected a number'),
        (SMALL + "mesh: {edge_length: .inf}", "mesh.edge_length = Infinity: expected a finite number"),
        (SMALL + "mesh: {file: brain.vtu}", 'mesh.file = "brain.vtu": no such file'),
        (SMALL + "start: {fraction: [1, 0.5]}", "start.fraction = [1, 0.5]: expected the lower value first"),
        (SMALL + "start: {lam: {csf: 1, grey: 2}}", "start.lam.grey = 2: unknown tissue; expected csf, gm, wm"),
        (SMALL + "start: {lam: soft}", 'start.lam = "soft": expected a number or keys with values'),
        (SMALL + "sampler: {chains: 1}", "stop.rhat: R-hat needs sampler.chains of at least 2"),
        (
            SMALL + "sampler: {thin: 10}\nstop: {max_steps: 15}",
            "stop.max_steps = 15: expected at least two kept draws, 20",
        ),
        (SMALL + "model: {elasticity: uniform}\nstart: {mu: {csf: 1, gm: 1, wm: 1}}", "start.mu"),
        (
            SMALL + "model: {elastic_prior: {nodes: [4, 4, 7]}}",
            "model.elastic_prior.nodes = [4, 4, 7]: expected at least three nodes",
        ),
        (SMALL + "model: {fixed: {mu: {grey: 1}}}", "model.fixed.mu.grey = 1: unknown tissue; expected csf, gm, wm"),
        (SMALL + "model: {field: {modes: 9}}", "it belongs to elasticity: field, which is tissue here"),
        (SMALL + "model: {elasticity: field, field: {modes: 0}}", "model.field.modes = 0: expected greater than or eq"),
        (SMALL + "model: {elasticity: field, field: {sd: -1}}", "model.field.sd = -1: expected greater than 0"),
        (SMALL + "known_boundary: brain.nii", 'known_boundary = "brain.nii": no such file'),
        (FILES + "known_boundary: truth", "the truth of this pair is not known; expected a file or null"),
        (SMALL + "known_boundary: truth", "model.priors.lam: a given boundary needs a prior with a finite high"),
        (
            SMALL + "known_boundary: truth\nmodel: {elastic_prior: {nodes: all}}",
            'model.elastic_prior.nodes = "all": expected the default',
        ),
        (
            SMALL + "known_boundary: truth\n" + PROPER + "}}",
            "model.elastic_prior.normalised = true: expected false with known_boundary",
        ),
        (SMALL + "model: {priors: {lam: {low: 3, high: 2}}}", 'model.priors.lam = {"low": 3, "high": 2}: a prior'),
        (SMALL + "model: {priors: {lam: {medain: 3, log_sd: 1}}}", "lam.medain = 3: unknown key; did you mean median?"),
        (SMALL + "model: {priors: {lam: {gm: {median: 3, low: 1}}}}", ": a prior is log-normal (median, log_sd) or"),
        (SMALL + "model: {priors: {lam: {gm: {median: -3}}}}", "priors.lam.gm.median = -3: expected greater than 0"),
        (SMALL.replace("paper", "paper, direction: [0, 0, 0]"), "simulate.direction = [0, 0, 0]: expected a direction"),
        (SMALL.replace("paper", "paper, making_edge_length: 9"), "simulate.making_edge_length = 9: unknown key"),
        (SMALL.replace("paper", "calibrated, making_edge_length: 20"), "expected less than mesh.edge_length, 15.5 mm"),
        (SMALL + similar("temperature: hot"), 'similarity.temperature = "hot": expected a number or keys with values'),
        (SMALL + similar("temperature: {median: 0}"), "similarity.temperature.median = 0: expected greater than 0"),
        (SMALL + similar("kind: student_t, degrees_of_freedom: 2"), "degrees_of_freedom = 2: expected greater than 2"),
        (SMALL + similar("kind: correlation"), "expected one of 'ssd', 'student_t', 'lc2', 'lncc', 'mi', 'mind'"),
        (SMALL + similar("kind: mi, temperature: {median: 1}"), "expected a number"),
        (SMALL + similar("window_mm: 3"), "window_mm = 3: unknown key"),
        (SMALL + "observations: [{kind: images, similarity: lncc, intensity_map: 1}]", "which has maps of its own"),
        (SMALL + "observations: [{kind: images, independent_points: residual}]", "residual needs quadrature: voxels"),
        (SMALL + "observations: [3]", "observations.0 = 3: expected keys with values, such as kind: landmarks"),
        (SMALL + "observations: [{sd: 1}]", "the kind is missing; expected one of images, landmarks"),
        (SMALL + "model: {elastic_prior: loud}", "expected one of 'boltzmann', 'loads'"),
        (SMALL + "model: {elastic_prior: {kind: loads, nodes: all}}", 'nodes = "all": unknown key'),
        (SMALL + "model: {elastic_prior: {temperature: {log_sd: 1}}}", "elastic_prior.temperature.median: missing"),
        (SMALL + "model: {elastic_prior: {temperature: {median: 9}}}", "a T_r with a prior needs normalised: true"),
        (
            SMALL + "model: {elastic_prior: {temperature: {median: 9}, normalised: true}, fixed: {}}",
            "model.fixed = {}: t_elastic of the elastic prior has a prior",
        ),
        (
            SMALL + "model: {elastic_prior: loads, fixed: {}, " + PRIORS + "}",
            "body_load and surface_load of the elastic",
        ),
        (
            SMALL + "model: {elastic_prior: {normalised: true}}",
            "model.priors.lam: elastic_prior: boltzmann, normalised, needs a prior with a finite high",
        ),
        (
            SMALL + "model: {elastic_prior: {normalised: true}, priors: {lam: {high: 9}}}",
            "model.priors.mu: elastic_prior",
        ),
        (SMALL + PROPER.replace("csf: {high: 9}, ", "") + "}}", "every free parameter, and lam of csf has none"),
        (SMALL + PROPER + ", held: {3: [0, 0, 1]}}}", "with normalised: true a node is held where it is"),
        (SMALL + PROPER + ", held: {3: [0, 0, 0]}}, rigid_sd: 2}", "model.rigid_sd = 2: with normalised: true"),
        ("extends: 3", "extends = 3: expected the path of a file"),
        ("extends: base.yaml", "base.yaml does not exist"),
        ("extends: run.yaml", "extends itself"),
    ],
)
def test_what_is_refused(write, text, message):
    assert message in complaint(write(text))


def test_a_file_that_is_no_text_and_one_that_is_a_folder(tmp_path):
    (tmp_path / "binary.yaml").write_bytes(b"seed: \xff\xfe")
    assert "is not UTF-8 text" in complaint(tmp_path / "binary.yaml")
    assert "is a folder" in complaint(tmp_path)


def test_a_config_error_is_an_input_error(write):
    with pytest.raises(InputError):
        load_config(write("data: 1"))


def test_relative_paths_are_looked_for_in_three_places(write, tmp_path, monkeypatch):
    path = write(SMALL + "mesh: {file: brain.vtu}")
    monkeypatch.setenv("BAYESREG_DATA", str(tmp_path / "data"))
    places = [tmp_path / folder / "brain.vtu" for folder in ("configs", "here", "data")]
    assert f"looked for {places[0]} and {places[1]} and {places[2]}" in complaint(path)
    for place in reversed(places):
        place.touch()
        assert load_config(path).mesh.file == place


def test_extends_merges_sections_key_by_key_and_replaces_values(write):
    write(SMALL + "sampler: {thin: 5, chains: 4}\nmodel: {fixed: {mu: {gm: 1}}, rigid_sd: 1}\n", "base.yaml")
    config = load_config(write("extends: base.yaml\nsampler: {chains: 2}\nmodel: {fixed: {lam: 3}}\n"))
    assert (config.sampler.thin, config.sampler.chains) == (5, 2)
    assert (config.model.fixed, config.model.rigid_sd) == ({"lam": 3.0}, 1)


def test_extends_replaces_a_section_of_another_kind(write):
    write(FILES, "base.yaml")
    config = load_config(write("extends: base.yaml\n" + SMALL))
    assert config.data.model_dump() == {"source": "mni152"}


def test_errors_name_the_file_that_the_value_comes_from(write):
    write("seed: x\n" + SMALL, "base.yaml")
    message = complaint(write("extends: base.yaml\n\nsampler: {thin: 0}\n"))
    assert "base.yaml:1: seed" in message
    assert "run.yaml:3: sampler.thin" in message


def test_overrides_are_typed_and_come_last(write):
    path = write(SMALL + "sampler: {chains: 2}\n")
    config = load_config(
        path, ["sampler.chains=5", "stop.rhat=null", "model.fixed.mu.gm=2e0", "simulate={kind: calibrated}"]
    )
    assert (config.sampler.chains, config.stop.rhat, config.model.fixed) == (5, None, {"mu": {"gm": 2.0}})
    assert config.simulate.kind == "calibrated"
    assert load_config(path).sampler.chains == 2


@pytest.mark.parametrize("override", ["seed", "=3", "a..b=3", "seed.x=3", "seed=[1", "sampler.chain=3"])
def test_overrides_that_make_no_sense(write, override):
    assert f"--set {override}" in complaint(write(SMALL + "seed: 1"), override)


def test_start_values_by_entry(write):
    start = load_config(write(SMALL + "start: {lam: 3, mu: {csf: 1, gm: 2, wm: 3}}")).start
    assert start.entries("lam", ["gm", "wm"]) == {"gm": 3, "wm": 3}
    assert start.entries("mu", ["csf", "gm", "wm"]) == {"csf": 1, "gm": 2, "wm": 3}
    assert load_config(write(SMALL)).start.entries("lam", ["all"]) is None


def test_the_model_of_a_resolved_configuration_needs_no_files(write):
    model = "model: {priors: {lam: {high: .inf}, mu: {gm: {high: 3}}}, elastic_prior: {held: {7: [0, 0.5, 0]}}}"
    config = load_config(write(SMALL + model))
    assert model_of(resolved_yaml(config)) == config.model


def test_schema_describes_every_section_and_forbids_unknown_keys():
    json_schema = schema()
    assert set(json_schema["properties"]) == {*Config.model_fields, "extends"}
    assert json_schema["additionalProperties"] is False
    temperature = json_schema["$defs"]["Boltzmann"]["properties"]["temperature"]["anyOf"]
    assert {"$ref": "#/$defs/ScalePrior"} in temperature
    kinds = json_schema["properties"]["observations"]["items"]["anyOf"]
    assert [{"$ref": f"#/$defs/{name}Section"} for name in ("Images", "Landmarks")] == kinds[:2]
    assert "similarity" in json_schema["$defs"]["ImagesSection"]["properties"]
    assert json_schema["$defs"]["RandomWalk"]["properties"]["sigma_u"]["description"].endswith("mm.")


@pytest.mark.parametrize(
    ("text", "preset"),
    [
        (FILES, "registration"),
        (FILES + "observations: [{kind: images, smoothing: 0.02}]", "registration"),
        (FILES + "model: {preset: paper}", "paper"),
        (FILES + "known_boundary: mesh.vtu\nmodel: {fixed: {lam: 1.0, mu: 1.0}}", "paper"),
        (FILES + "observations: [{kind: landmarks, file: points.csv}]", "registration"),
        ("data: {source: files}\nmesh: {file: mesh.vtu}\n" + POINTS, "registration"),
        (SMALL, "paper"),
    ],
)
def test_what_comes_from_files_has_the_model_for_real_data(write, text, preset):
    path = write(text)
    for name in ("mesh.vtu", "points.csv"):
        (path.parent / name).touch()
    config = load_config(path)
    expected = ModelConfig(preset=preset)
    assert config.model.model_dump(exclude={"fixed"}) == expected.model_dump(exclude={"fixed"})
    for pair in config.pairs_of_images:
        usual = ImageOptions(**with_preset(preset, {}))
        given_smoothing = {"smoothing": 0.02} if "0.02" in text else {}
        assert ImageOptions(**pair.options) == usual.model_copy(update=given_smoothing)


def test_an_override_names_the_first_observation_where_none_is_listed(write):
    path = write(FILES)
    config = load_config(path, ["observations.0.similarity=lncc"])
    (images,) = config.observations
    assert (images.similarity.kind, images.intensity_map, images.quadrature) == ("lncc", None, "voxels")
    assert config.model.elastic_prior.kind == "loads"


@pytest.mark.parametrize("name", ["hmc", "nuts", "smc", "laplace"])
def test_a_sampler_that_follows_the_gradient_is_refused_beside_a_hard_wall(write, name):
    text = SMALL + "model: {skull_width: 0}\n"
    expected = "expected model.skull_width: 0.5, or the paper's model and sampler, model.preset: paper and sampler.name"
    assert expected in complaint(write(text + f"sampler: {name}\n"))
    assert expected in complaint(write(text))
    assert load_config(write(text + "sampler: rwmh\n")).sampler.name == "rwmh"


def test_another_quadrature_leaves_out_what_needs_voxels(write):
    options = load_config(write(FILES + "observations: [{kind: images, quadrature: gauss4}]\n")).image_options
    assert (options.most_points, options.independent_points, options.interpolation) == (None, None, "cubic")


def test_a_key_of_another_kind_of_observation_is_not_suggested(write):
    assert "this kind has no such key" in complaint(write(SMALL + "observations: [{kind: images, sd: 2}]\n"))
