"""Construction of a tetrahedral mesh from tissue labels, and files of meshes."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesreg.distance import forbidden, signed_distance
from bayesreg.image import Image
from bayesreg.io.atomic import replacing
from bayesreg.io.cells import tissue_of_cells
from bayesreg.io.domain import MeshError, domain_labels, labels_everywhere, mesh_domain
from bayesreg.io.fitting import depth_of_region, fit_to_surface, pull_inside
from bayesreg.io.loose_nodes import without_loose_nodes
from bayesreg.io.quality import MeshQuality, check_mesh
from bayesreg.io.surface_files import read_dataset, save_dataset
from bayesreg.io.surfaces import Sizing, Surface, depth_sizing, smoothed_region, tissue_surfaces
from bayesreg.io.tetwild import tetrahedralize
from bayesreg.io.thickness import resolved
from bayesreg.mesh import FACES, TetMesh
from bayesreg.tissues import BRAIN, BRAIN_CLOSING, BRAIN_EDGE, BRAIN_GAP
from bayesreg.types import AnyArray, InputError

__all__ = [
    "MeshError",
    "MeshOptions",
    "MeshQuality",
    "build_mesh",
    "check_mesh",
    "domain_labels",
    "load_mesh",
    "mesh_domain",
    "save_mesh",
    "tissue_of_cells",
]

NAMES_FIELD = "tissue_names"
# The default envelope in units of the edge length.
ENVELOPE = 0.32

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class MeshOptions:
    """Options of the mesh. The defaults give a brain about as many nodes as in the paper (801, 349 on the boundary).

    Attributes
    ----------
    edge_length : float
        Target length of an edge on the boundary, mm.
    inner_edge_length : float, optional
        Largest length of an edge deep inside, mm; the default is 1.9 edge lengths. Tissue boundaries may make edges
        shorter.
    envelope : float, optional
        Largest distance of faces from the surfaces of the labels, mm; the default is 0.32 edge lengths. Every
        further attempt halves it.
    skull_gap : float
        Least distance of the boundary nodes from the outside of the intracranial mask, mm.
    closing : float
        Radius of the ball that closes the solid tissues to a hull, mm; used only if a tissue is a fluid.
    stop_energy : float
        Quality at which fTetWild may stop (AMIPS energy, 3 at best). Half this value takes several times as long.
    threads : int
        Threads of fTetWild; 0 for all cores.
    attempts : int
        Largest number of meshes to try. fTetWild is not deterministic, so that a new attempt can succeed.
    quiet : bool
        Whether to suppress fTetWild's own output.
    """

    edge_length: float = BRAIN_EDGE
    inner_edge_length: float | None = None
    envelope: float | None = None
    skull_gap: float = BRAIN_GAP
    closing: float = BRAIN_CLOSING
    stop_energy: float = 20.0
    threads: int = 0
    attempts: int = 3
    quiet: bool = True

    def __post_init__(self) -> None:
        for name in ("edge_length", "inner_edge_length", "envelope", "stop_energy", "attempts"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"mesh option {name} must be positive, got {value}")
        for name in ("skull_gap", "closing", "threads"):
            if not getattr(self, name) >= 0:
                raise InputError(f"mesh option {name} must not be negative, got {getattr(self, name)}")
        if self.inner_edge_length is not None and self.inner_edge_length < self.edge_length:
            raise InputError(
                f"mesh option inner_edge_length must be at least edge_length ({self.edge_length:g} mm), "
                f"got {self.inner_edge_length:g}"
            )


def build_mesh(
    tissue: Image,
    intracranial: Image | None = None,
    options: MeshOptions = MeshOptions(),
    domain: Image | None = None,
    names: Sequence[str] = BRAIN,
) -> TetMesh:
    """Mesh the region Ω of an organ, with one tissue per tetrahedron and boundary nodes at a distance from the skull.

    The result is not deterministic, since fTetWild is not. Keep the mesh instead of building it again.

    Parameters
    ----------
    tissue : Image
        0 outside, 1 + index into the names inside.
    intracranial : Image, optional
        Nonzero inside the skull, on the same grid. Without it nothing bounds the mesh.
    options : MeshOptions
    domain : Image, optional
        The region Ω, if `mesh_domain` has already computed it.
    names : sequence of str
        Names of the tissues; the default is those of the brains that the package ships.

    Returns
    -------
    TetMesh
        The mesh in world RAS, mm.

    Raises
    ------
    MeshError
        If the labels or the mask cannot be meshed (see `mesh_domain`), or no attempt gave a mesh that passes
        `check_mesh`.
    """
    domain = domain or mesh_domain(tissue, intracranial, options.closing, names)
    labels = domain_labels(tissue, resolved(domain, options.edge_length), names)
    surfaces = tissue_surfaces(labels, options.edge_length, names)
    field = smoothed_region(labels, options.edge_length)
    sizing = depth_sizing(labels, options.edge_length, options.inner_edge_length or 1.9 * options.edge_length)
    depth = depth_of_region(labels, options.edge_length)
    skull_distance = None if intracranial is None else signed_distance(forbidden(intracranial))
    for attempt in range(1, options.attempts + 1):
        try:
            # Within a smaller envelope the mesh has more nodes, and follows the surfaces more closely.
            envelope = (options.envelope or ENVELOPE * options.edge_length) / 2 ** (attempt - 1)
            mesh = _attempt(labels, names, surfaces, field, sizing, depth, skull_distance, envelope, options)
            _log.debug("mesh made: %s", check_mesh(mesh, labels))
            return mesh
        except ValueError as error:
            _log.warning("mesh %d of at most %d failed its check: %s", attempt, options.attempts, error)
            last = error
    raise MeshError(
        f"none of {options.attempts} meshes is sound, the last one because {last}; choose a shorter mesh.edge_length"
    ) from last


def save_mesh(
    mesh: TetMesh,
    path: str | Path,
    point_data: Mapping[str, AnyArray] | None = None,
    cell_data: Mapping[str, AnyArray] | None = None,
) -> None:
    """Write a mesh as a .vtu file in one step.

    Parameters
    ----------
    mesh : TetMesh
    path : path
        Ends in .vtu.
    point_data : mapping, optional
        Further arrays of one row per node, by name.
    cell_data : mapping, optional
        Further arrays of one row per tetrahedron, by name.

    Raises
    ------
    InputError
        If the path has another suffix, its folder does not exist, or an array does not have one row per node or
        tetrahedron.
    """
    import pyvista

    path = Path(path)
    if path.suffix != ".vtu":
        raise InputError(f"a mesh file must end in .vtu, got {path}")
    if not path.parent.is_dir():
        raise InputError(f"{path} cannot be written: there is no folder {path.parent}")
    nodal = _rows(point_data, len(mesh.points), "node")
    by_cell = {"tissue": mesh.tissue, **_rows(cell_data, len(mesh.cells), "tetrahedron")}
    grid = pyvista.UnstructuredGrid({pyvista.CellType.TETRA: mesh.cells}, mesh.points)
    for target, arrays in ((grid.point_data, nodal), (grid.cell_data, by_cell)):
        for name, values in arrays.items():
            target[name] = values
    # The names are UTF-8 bytes, separated by zeros, since texts in VTK's files are ASCII.
    grid.field_data[NAMES_FIELD] = np.frombuffer("\0".join(mesh.names).encode(), np.uint8)
    with replacing(path) as temporary:
        save_dataset(grid, temporary)


def _rows(arrays_by_name: Mapping[str, AnyArray] | None, count: int, entity: str) -> dict[str, np.ndarray]:
    arrays = {name: np.asarray(values) for name, values in (arrays_by_name or {}).items()}
    for name, values in arrays.items():
        if values.shape[:1] != (count,):
            raise InputError(f"{name} must have {count} rows, one per {entity}; got shape {values.shape}")
    return arrays


def load_mesh(path: str | Path, names: Sequence[str] = BRAIN) -> TetMesh:
    """Read a mesh in the format of `save_mesh`.

    Parameters
    ----------
    path : path
    names : sequence of str
        Names of the tissues if the file has none; the default is those of brains.

    Raises
    ------
    InputError
        If the file does not exist or cannot be read, holds no cells or cells other than tetrahedra, has no "tissue" per
        cell, is not a valid mesh, or has a tetrahedron twice.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"mesh {path}: there is no such file")
    try:
        grid = read_dataset(path)
    except ValueError as error:
        raise InputError(f"mesh {path} cannot be read: {error}") from error
    kinds = sorted(kind.name.lower() for kind in grid.distinct_cell_types)
    if kinds != ["tetra"]:
        raise InputError(f"mesh {path} must consist of tetrahedra, got {', '.join(kinds) or 'no cells'}")
    if "tissue" not in grid.cell_data:
        raise InputError(f"mesh {path} has no cell data 'tissue'; it holds {sorted(grid.cell_data.keys()) or 'none'}")
    try:
        stored = grid.field_data.get(NAMES_FIELD)
        names = names if stored is None else bytes(stored.astype(np.uint8)).decode().split("\0")
        cells = grid.cells.reshape(-1, 5)[:, 1:]
        mesh = TetMesh.from_arrays(grid.points, cells, grid.cell_data["tissue"], names)
    except ValueError as error:
        raise InputError(f"mesh {path}: {error}") from error
    _require_one_body(mesh, path)
    return mesh


def _require_one_body(mesh: TetMesh, path: Path) -> None:
    """Raise InputError if tetrahedra overlap, as far as shared nodes and faces show it."""
    cells, counts = np.unique(np.sort(mesh.cells, axis=1), axis=0, return_counts=True)
    if (counts > 1).any():
        raise InputError(
            f"mesh {path} holds the tetrahedron of the nodes {cells[counts > 1][0].tolist()} more than once"
        )
    faces, counts = np.unique(np.sort(mesh.cells[:, FACES].reshape(-1, 3), axis=1), axis=0, return_counts=True)
    if (counts > 2).any():
        raise InputError(f"mesh {path}: more than two tetrahedra share the face {faces[counts > 2][0].tolist()}")


def _attempt(
    labels: Image,
    names: Sequence[str],
    surfaces: list[Surface],
    field: Image,
    sizing: Sizing,
    depth: Image,
    skull_distance: Image | None,
    envelope: float,
    options: MeshOptions,
) -> TetMesh:
    points, cells = tetrahedralize(
        surfaces,
        field,
        sizing,
        envelope=envelope,
        stop_energy=options.stop_energy,
        threads=options.threads,
        quiet=options.quiet,
    )
    points, cells = without_loose_nodes(points, cells)
    mesh = fit_to_surface(TetMesh.from_arrays(points, cells, np.zeros(len(cells), int), names), depth)
    if skull_distance is not None:
        mesh = pull_inside(mesh, skull_distance, options.skull_gap)
    tissue = tissue_of_cells(mesh.points, cells, labels_everywhere(labels, names))
    return TetMesh.from_arrays(mesh.points, cells, tissue, names)
