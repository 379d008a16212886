"""The whole configuration: its sections together, their defaults, and the checks between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from bayesreg.config.data import BrainWebData, CalibratedPair, FilesData, Mni152Data, PaperPair
from bayesreg.config.samplers import Auto, SamplerConfig, name_where_unnamed
from bayesreg.config.sections import EvaluationConfig, MeshConfig, ReportConfig, ResultsConfig, StartConfig, StopConfig
from bayesreg.config.values import find_boundary
from bayesreg.model.observations.images.options import ImageOptions, with_preset
from bayesreg.model.observations.images.section import ImagesSection
from bayesreg.model.observations.registry import Observations
from bayesreg.model.options import ModelConfig
from bayesreg.settings import Section
from bayesreg.settings import wrong as _wrong
from bayesreg.tissues import BRAIN_EDGE


def _require_tissues(key: str, option: object, names: Sequence[str] | None, require_all: bool = False) -> None:
    """Raise an error for unknown names of tissues and, with `require_all`, for missing tissues."""
    if not isinstance(option, Mapping) or names is None:
        return
    for tissue in sorted(set(option) - set(names)):
        raise _wrong(f"{key}.{tissue}", f"unknown tissue; expected {', '.join(names)}")
    if require_all and (missing := [name for name in names if name not in option]):
        raise _wrong(key, f"lacks {', '.join(missing)}; expected a value for every tissue")


def _has_images(data: Mni152Data | BrainWebData | FilesData) -> bool:
    return not isinstance(data, FilesData) or data.fixed is not None


def _require_nothing_else(model: ModelConfig) -> None:
    """Raise an error for options of the elastic prior that contradict known_boundary."""
    elastic = model.elastic_prior
    if elastic.nodes != "boundary" or elastic.held:
        key = "held" if elastic.held else "nodes"
        message = "expected the default: known_boundary holds the boundary, and no other node is sampled"
        raise _wrong(f"elastic_prior.{key}", message)
    if elastic.normalised:
        raise _wrong(
            "elastic_prior.normalised", "expected false with known_boundary: a given u_B has no prior to be normalised"
        )


def complete(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """Add the default preset of the model and the default observations to an unchecked configuration.

    The default preset is `registration` for data from files, and `paper` for a synthetic pair or a known boundary. The
    default observation is the pair of images, if there is one.
    """
    data, completed = configuration.get("data"), dict(configuration)
    if not isinstance(data, Mapping):
        return completed
    from_files = data.get("source") == "files"
    if configuration.get("observations") is None:
        completed["observations"] = [] if from_files and data.get("fixed") is None else [{"kind": "images"}]
    model = configuration.get("model") or {}
    if isinstance(model, Mapping) and "preset" not in model:
        registers = from_files and configuration.get("known_boundary") is None
        completed["model"] = {"preset": "registration" if registers else "paper", **model}
    return completed


def _with_image_options(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """Add the preset's options to every pair of images in a completed configuration; options that it holds stay."""
    model, observations = configuration.get("model"), configuration.get("observations")
    preset = model.get("preset") if isinstance(model, Mapping) else getattr(model, "preset", None)
    if preset not in ("paper", "registration") or not isinstance(observations, list):
        return dict(configuration)
    are_images = [
        isinstance(observation, Mapping) and observation.get("kind") == "images" for observation in observations
    ]
    return {
        **configuration,
        "observations": [
            with_preset(preset, observation) if is_images else observation
            for observation, is_images in zip(observations, are_images, strict=True)
        ],
    }


class Config(Section):
    """The complete configuration of a run."""

    description: str = ""
    """The purpose of the run, in words."""
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**32)] = 0
    data: Annotated[Mni152Data | BrainWebData | FilesData, Field(discriminator="source")]
    mesh: Annotated[MeshConfig, Field(validate_default=True)] = MeshConfig()
    simulate: Annotated[
        Annotated[PaperPair | CalibratedPair, Field(discriminator="kind")] | None, Field(validate_default=True)
    ] = None
    """The synthetic pair that is made from the anatomy; null for data from files."""
    known_boundary: Annotated[Literal["truth"] | Path | None, BeforeValidator(find_boundary)] = None
    """Elastography: the displacement of the boundary is known, and only λ and μ are sampled. The value is truth (of a
    synthetic pair) or a file (.vtu or .npz of this mesh, or a displacement field .nii, .nii.gz). null samples both."""
    observations: Observations = Field(default=[])
    """The data of the run; null is only the pair of images, if there is one."""
    model: Annotated[ModelConfig, Field(validate_default=True)] = ModelConfig()
    """The model; preset: registration is the default for data from files, preset: paper for synthetic pairs."""
    sampler: Annotated[
        SamplerConfig,
        Field(discriminator="name", validate_default=True),
        BeforeValidator(name_where_unnamed),
    ] = Auto()
    start: StartConfig = StartConfig()
    stop: Annotated[StopConfig, Field(validate_default=True)] = StopConfig()
    report: ReportConfig = ReportConfig()
    results: ResultsConfig = ResultsConfig()
    evaluation: EvaluationConfig | None = None
    """The held-out landmarks for the evaluation."""

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, configuration: Any) -> Any:
        return _with_image_options(complete(configuration)) if isinstance(configuration, Mapping) else configuration

    # Checks between sections are validators of fields: pydantic skips validators of the model if a field is wrong.

    @field_validator("simulate")
    @classmethod
    def _fits_data(
        cls, simulate: PaperPair | CalibratedPair | None, info: ValidationInfo
    ) -> PaperPair | CalibratedPair | None:
        data, mesh = info.data.get("data"), info.data.get("mesh")
        if isinstance(data, FilesData) and simulate is not None:
            raise ValueError("expected null: data.source is files, a pair that needs no making")
        if isinstance(data, Mni152Data | BrainWebData) and simulate is None:
            raise ValueError(
                f"missing: data.source is {data.source}, one image, of which a pair must be made; give its kind"
            )
        if (
            isinstance(simulate, CalibratedPair)
            and mesh
            and not mesh.file
            and simulate.making_edge_length >= (edge := mesh.edge_length or BRAIN_EDGE)
        ):
            raise _wrong("making_edge_length", f"expected less than mesh.edge_length, {edge:g} mm")
        if simulate is not None:
            _require_tissues("lam", simulate.lam, data and data.tissues, require_all=True)
            _require_tissues("mu", simulate.mu, data and data.tissues, require_all=True)
        return simulate

    @field_validator("mesh")
    @classmethod
    def _is_there(cls, mesh: MeshConfig, info: ValidationInfo) -> MeshConfig:
        data = info.data.get("data")
        if isinstance(data, FilesData) and data.labels is None and data.fixed is None and mesh.file is None:
            raise _wrong("file", "missing: without data.labels and images nothing can be meshed; expected a .vtu file")
        return mesh

    @field_validator("observations")
    @classmethod
    def _are_there(cls, observations: Observations, info: ValidationInfo) -> Observations:
        data = info.data.get("data")
        names = [observation.name for observation in observations if isinstance(observation, ImagesSection)]
        if names and data is not None and not _has_images(data):
            raise ValueError("images are observed, and data has none; expected data.fixed and data.moving")
        if names and "images" not in names:
            raise ValueError(f"{names[0]} is a second pair of images, and the first is left out; expected kind: images")
        if len(names) > 1 and data is not None and not isinstance(data, FilesData):
            raise ValueError(f"expected one pair of images, the one that is made of data.source: {data.source}")
        return observations

    @property
    def has_images(self) -> bool:
        """Whether there is a pair of images."""
        return _has_images(self.data)

    @property
    def pairs_of_images(self) -> list[ImagesSection]:
        """The pairs of images among the observations; the pair of the section data comes first."""
        pairs = [observation for observation in self.observations if isinstance(observation, ImagesSection)]
        return sorted(pairs, key=lambda pair: pair.fixed is not None)

    @property
    def image_options(self) -> ImageOptions:
        """The options for the comparison of the pair in the section data; the defaults if it is not compared."""
        return next(iter(self.pairs_of_images), ImageOptions())

    @field_validator("known_boundary")
    @classmethod
    def _is_known(cls, boundary: Path | str | None, info: ValidationInfo) -> Path | str | None:
        if boundary == "truth" and "simulate" in info.data and info.data["simulate"] is None:
            raise ValueError("the truth of this pair is not known; expected a file or null")
        return boundary

    @field_validator("model")
    @classmethod
    def _names_tissues_and_nodes(cls, model: ModelConfig, info: ValidationInfo) -> ModelConfig:
        if "data" not in info.data:
            return model
        names = info.data["data"].tissues
        for key, section in (("fixed", model.fixed or {}), ("priors", model.priors)):
            for parameter, values in section.items():
                _require_tissues(f"{key}.{parameter}", values, names)
        if info.data.get("known_boundary") is not None:
            _require_nothing_else(model)
            if names is not None:
                no_node = model.elastic_prior.model_copy(update={"nodes": []})
                model.model_copy(update={"elastic_prior": no_node}).require_proper_priors(names)
        elif not isinstance(nodes := model.elastic_prior.nodes, str) and len({*nodes, *model.elastic_prior.held}) < 3:
            raise _wrong(
                "elastic_prior.nodes", "expected at least three nodes, held ones included; fewer do not hold the mesh"
            )
        if names is not None:
            model.require_proper_priors(names)
        return model

    @field_validator("sampler")
    @classmethod
    def _meets_a_soft_wall(cls, sampler: SamplerConfig, info: ValidationInfo) -> SamplerConfig:
        model, has_skull = info.data.get("model"), info.data.get("simulate") is not None
        has_skull |= getattr(info.data.get("data"), "intracranial", None) is not None
        if model is not None and model.skull_width == 0 and has_skull and sampler.name != "rwmh":
            raise ValueError(
                "samplers that follow the gradient need a soft wall of the skull; expected model.skull_width: 0.5, or "
                "the paper's model and sampler, model.preset: paper and sampler.name: rwmh"
            )
        return sampler

    @field_validator("start")
    @classmethod
    def _can_start(cls, start: StartConfig, info: ValidationInfo) -> StartConfig:
        model, data = info.data.get("model"), info.data.get("data")
        if start.field == "truth" and "simulate" in info.data and info.data["simulate"] is None:
            raise _wrong("field", "the truth of this pair is not known; expected identity or a file")
        if start.field == "demons" and data is not None and not _has_images(data):
            raise _wrong("field", "demons need a pair of images; expected identity or a file")
        for name in ("lam", "mu"):
            _require_tissues(name, getattr(start, name), data and data.tissues)
            if model is None or model.elasticity in ("tissue", "field"):
                continue
            if isinstance(getattr(start, name), dict):
                raise _wrong(name, f"expected one number, since model.elasticity is {model.elasticity}")
        return start

    @field_validator("stop")
    @classmethod
    def _can_stop(cls, stop: StopConfig, info: ValidationInfo) -> StopConfig:
        sampler = info.data.get("sampler")
        if sampler and sampler.chains < 2 and stop.rhat is not None:
            raise _wrong("rhat", "R-hat needs sampler.chains of at least 2; expected null with one chain")
        if sampler and stop.max_steps < 2 * sampler.thin:
            raise _wrong("max_steps", f"expected at least two kept draws, {2 * sampler.thin} steps")
        return stop
