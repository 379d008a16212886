"""Choose the lengths of a mesh by the size of the organ, and build or load the mesh."""

from __future__ import annotations

from pathlib import Path

from bayesreg.config import Config
from bayesreg.config.data import FilesData
from bayesreg.config.sections import MeshConfig
from bayesreg.image import Image
from bayesreg.io.datasets import Anatomy
from bayesreg.io.domain import size_of_solid
from bayesreg.io.meshing import MeshOptions, build_mesh, load_mesh
from bayesreg.mesh import TetMesh
from bayesreg.tissues import BRAIN_EDGE, BRAIN_GAP
from bayesreg.types import InputError


def size_of_organ(config: Config, anatomy: Anatomy) -> float:
    """Return the size of the organ relative to a human brain; it is one for the data that ship, which are brains."""
    return size_of_solid(anatomy.tissue, anatomy.names) if isinstance(config.data, FilesData) else 1.0


def complete_lengths(settings: MeshConfig, size: float) -> MeshConfig:
    """Complete the settings of the mesh with the default lengths for an organ of this size."""
    usual = {"edge_length": size * BRAIN_EDGE, "skull_gap": size * BRAIN_GAP}
    return settings.model_copy(update={name: x for name, x in usual.items() if getattr(settings, name) is None})


def mesh_of(anatomy: Anatomy, domain: Image, settings: MeshConfig, edge_length: float | None = None) -> TetMesh:
    """Build the mesh of an anatomy, or load it from the file of the settings; a given edge length (mm) builds one."""
    if settings.file is not None and edge_length is None:
        return _load_mesh(settings.file, anatomy.names)
    assert settings.edge_length is not None
    assert settings.skull_gap is not None
    options = MeshOptions(
        edge_length=edge_length or settings.edge_length,
        envelope=None if edge_length else settings.envelope,
        skull_gap=settings.skull_gap,
    )
    return build_mesh(anatomy.tissue, anatomy.intracranial, options, domain, anatomy.names)


def _load_mesh(path: Path, names: tuple[str, ...]) -> TetMesh:
    """Load a mesh from a file; InputError if its tissues differ from those of the labels."""
    mesh = load_mesh(path, names)
    if mesh.names != names:
        raise InputError(
            f"mesh.file {path} has the tissues {', '.join(mesh.names)}, and the labels have {', '.join(names)}: both "
            "need the same names in the same order"
        )
    return mesh
