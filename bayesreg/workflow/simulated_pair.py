"""Make the synthetic pair that a configuration describes."""

from __future__ import annotations

import numpy as np

from bayesreg.config import Config
from bayesreg.config.data import CalibratedPair
from bayesreg.config.sections import MeshConfig
from bayesreg.image import Image
from bayesreg.io.datasets import Anatomy
from bayesreg.mesh import TetMesh
from bayesreg.synthetic.pair import SyntheticPair, make_pair
from bayesreg.workflow.meshing import mesh_of


def simulate_pair(
    config: Config,
    meshed: MeshConfig,
    fixed: Image,
    anatomy: Anatomy,
    domain: Image,
    skull: Image | None,
    mesh: TetMesh,
) -> SyntheticPair:
    """Make the synthetic pair of the section simulate."""
    settings = config.simulate
    assert settings is not None
    assert skull is not None
    making = mesh
    if isinstance(settings, CalibratedPair):
        making = mesh_of(anatomy, domain, meshed, settings.making_edge_length)
    smoothing = {} if settings.smoothing_mm is None else {"smoothing_mm": settings.smoothing_mm}
    return make_pair(
        fixed,
        anatomy.tissue,
        skull,
        making,
        lam=np.array([settings.lam[name] for name in anatomy.names]),
        mu=np.array([settings.mu[name] for name in anatomy.names]),
        displacement=settings.displacement,
        patch_nodes=settings.patch_nodes,
        direction=settings.direction,
        noise_sd=settings.noise_sd,
        seed=config.seed,
        **smoothing,
    )


def describe_pair(config: Config, pair: SyntheticPair) -> dict[str, object]:
    """Describe a synthetic pair besides its truth, for the provenance of the run."""
    assert config.simulate is not None
    same = "the mesh of the registration (the inverse crime)"
    return {
        "kind": config.simulate.kind,
        "made_on": same if config.simulate.kind == "paper" else f"a finer mesh of {len(pair.mesh.points)} nodes",
        "noise_sd": pair.noise_sd,
        "smoothing_mm": pair.smoothing_mm,
        "residual_sd_at_truth": pair.residual_sd,
        "interpolation_sd_at_truth": pair.interpolation_sd,
        "patch": pair.deformation.patch.tolist(),
        "contact": pair.deformation.contact.tolist(),
        "least_volume_ratio": float(pair.deformation.volume_ratio.min()),
    }
