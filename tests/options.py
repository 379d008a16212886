"""Posteriors of tests from one mapping of options: those of the model and those of its pair of images side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bayesreg as br
from bayesreg.model.observations.images.options import ImageOptions

# Short words for the settings of the elastic prior and of the similarity.
BOLTZMANN = {"t_elastic": "temperature", "normalised": "normalised", "sampled": "nodes", "held": "held"}
LOADS = {"body_load": "body", "surface_load": "surface"}
SIMILARITY = {"t_similarity": "temperature", "degrees_of_freedom": "degrees_of_freedom", "window_mm": "window_mm"}


def model_of(**options: Any) -> br.ModelConfig:
    """The model of options, of which those of images are left out."""
    elastic = _named(options, BOLTZMANN) or {}
    loads = _named(options, LOADS)
    words = (*BOLTZMANN, *LOADS, *SIMILARITY, *ImageOptions.model_fields)
    model_options = {name: value for name, value in options.items() if name not in words}
    if loads:
        model_options["elastic_prior"] = {"kind": "loads", **loads}
    elif elastic:
        model_options["elastic_prior"] = {"kind": "boltzmann", **elastic}
    return br.ModelConfig(**model_options)


def image_options_of(**options: Any) -> dict[str, Any]:
    """The options of a pair of images, of which those of the model are left out."""
    image_options = {name: options[name] for name in ImageOptions.model_fields if name in options}
    settings = _named(options, SIMILARITY)
    if settings or "similarity" in image_options:
        similarity = image_options.get("similarity", "ssd")
        image_options["similarity"] = {"kind": similarity, **settings} if isinstance(similarity, str) else similarity
    return image_options


def posterior_of(
    fixed: br.Image, moving: br.Image, mesh: br.TetMesh, /, skull: br.Image | None = None, reference: Any = None,
    **options: Any,
) -> br.Posterior:  # fmt: skip
    """The posterior of one pair of images."""
    pair = br.ImagePair(fixed, moving, **image_options_of(**options))
    return br.build_posterior(mesh, [pair], model_of(**options), skull, reference)


def _named(options: Mapping[str, Any], words: Mapping[str, str]) -> dict[str, Any]:
    return {name: options[word] for word, name in words.items() if word in options}
