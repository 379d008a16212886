"""Bayesian estimation of deformation and elastic parameters in non-rigid registration."""

import importlib
import os
import sys
from typing import Any

# JAX reads this variable at its first import, so that float64 is enabled without importing JAX here.
os.environ["JAX_ENABLE_X64"] = "true"
if "jax" in sys.modules:
    sys.modules["jax"].config.update("jax_enable_x64", True)

__version__ = "0.1.0"

_HOME = {
    "Image": "image",
    "TetMesh": "mesh",
    "Equilibrium": "types",
    "InputError": "types",
    "strain_energy": "fem.elasticity",
    "solve_interior": "fem.equilibrium",
    "ModelConfig": "model.options",
    "PriorConfig": "model.options",
    "Boltzmann": "model.elastic.boltzmann",
    "RandomLoads": "model.elastic.loads",
    "ScalePrior": "settings",
    "Posterior": "model.posterior",
    "build_posterior": "model.build",
    "ImagePair": "model.observations.images.pair",
    "SquaredDifferences": "model.observations.images.pointwise",
    "StudentT": "model.observations.images.pointwise",
    "LocalCorrelation": "model.observations.images.local_correlation",
    "MutualInformation": "model.observations.images.mutual_information",
    "SelfSimilarity": "model.observations.images.self_similarity",
    "Landmarks": "model.observations.landmarks",
    "Surface": "model.observations.surface",
    "NormalNoise": "model.observations.point_noise",
    "StudentTNoise": "model.observations.point_noise",
    "independent_points": "model.observations.images.independence",
    "make_pair": "synthetic.pair",
    "Start": "inference.chains.initialise",
    "StopRule": "inference.chains.stopping",
    "sample": "inference.chains.run",
    "load_image": "io.volumes",
    "read_point_pairs": "io.points",
    "save_image": "io.volumes",
    "MeshOptions": "io.meshing",
    "build_mesh": "io.meshing",
    "load_mesh": "io.meshing",
    "save_mesh": "io.meshing",
    "apply": "results.apply",
    "maps": "results.maps",
    "load_config": "config",
    "load_result": "results.result",
    "run": "workflow.run",
}

__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'bayesreg' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"bayesreg.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
