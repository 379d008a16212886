"""Represent tetrahedral meshes with one tissue per tetrahedron."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from bayesreg.printable import require_printable
from bayesreg.tissues import BRAIN
from bayesreg.types import AnyArray, InputError

# The faces of a positively oriented tetrahedron; their normals point outwards.
FACES = np.array([(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)])


@dataclass(frozen=True, eq=False)
class TetMesh:
    """A tetrahedral mesh in world space. Make a mesh with `from_arrays`, which checks the arrays.

    Attributes
    ----------
    points : (n, 3) float array
        Coordinates of the nodes, world RAS, mm.
    cells : (m, 4) int array
        Node indices of each tetrahedron, positively oriented.
    tissue : (m,) int array
        Index into `names` of each tetrahedron's tissue.
    names : tuple of str
        Tissue names.
    """

    points: Float[np.ndarray, "nodes 3"]
    cells: Int[np.ndarray, "cells 4"]
    tissue: Int[np.ndarray, "cells"]
    names: tuple[str, ...]

    @classmethod
    def from_arrays(cls, points: AnyArray, cells: AnyArray, tissue: AnyArray, names: Sequence[str] = BRAIN) -> TetMesh:
        """Check arrays and make a mesh of them.

        Raises
        ------
        ValueError
            If a shape or an index is wrong, a coordinate is not finite, a tetrahedron has no positive volume, a node
            belongs to no tetrahedron, or a name cannot be printed. The topology is not checked.
        """
        points, cells, tissue = np.array(points, float), np.array(cells), np.array(tissue)
        _require_shapes(points, cells, tissue)
        cells, tissue = cells.astype(np.int64), tissue.astype(np.int64)
        if not np.isfinite(points).all():
            raise InputError(f"node {np.argwhere(~np.isfinite(points))[0, 0]} has a coordinate that is not finite")
        if cells.min() < 0 or cells.max() >= len(points):
            raise InputError(f"cells name nodes {cells.min()} to {cells.max()}, but there are {len(points)} points")
        if tissue.min() < 0 or tissue.max() >= len(names):
            raise InputError(f"tissue holds {tissue.min()} to {tissue.max()}, but names has {len(names)} entries")
        require_printable(names, "tissues")
        mesh = cls(points, cells, tissue, tuple(names))
        bad = np.flatnonzero(~(mesh.volumes > 0))
        if len(bad):
            raise InputError(f"{len(bad)} tetrahedra have no positive volume, the first is cell {bad[0]}")
        unused = np.setdiff1d(np.arange(len(points)), cells)
        if len(unused):
            raise InputError(f"{len(unused)} nodes belong to no tetrahedron, the first is node {unused[0]}")
        return mesh

    @cached_property
    def volumes(self) -> Float[np.ndarray, "cells"]:
        """The signed volume of every tetrahedron, mm³."""
        return signed_volumes(self.points, self.cells)

    @cached_property
    def nodal_volumes(self) -> Float[np.ndarray, "nodes"]:
        """The volume of every node, mm³: a quarter of the volumes of its tetrahedra."""
        return np.bincount(self.cells.ravel(), np.repeat(self.volumes / 4, 4), len(self.points))

    @cached_property
    def boundary_faces(self) -> Int[np.ndarray, "faces 3"]:
        """The triangles that belong to exactly one tetrahedron, with normals outwards."""
        return boundary_faces_of(self.cells)

    @cached_property
    def boundary_edge(self) -> float:
        """The mean length of the edges of the boundary's triangles, mm."""
        corner = self.points[self.boundary_faces]
        return float(np.linalg.norm(corner - np.roll(corner, -1, axis=1), axis=2).mean())

    @cached_property
    def neighbours(self) -> Int[np.ndarray, "pairs 2"]:
        """The pairs of tetrahedra that share a face."""
        return _shared_faces(self.cells) // 4

    @cached_property
    def boundary(self) -> Int[np.ndarray, "boundary"]:
        """The sorted indices of the nodes on the boundary."""
        return np.unique(self.boundary_faces)

    @cached_property
    def interior(self) -> Int[np.ndarray, "interior"]:
        """The sorted indices of the nodes that are not on the boundary."""
        return np.setdiff1d(np.arange(len(self.points)), self.boundary)

    @cached_property
    def digest(self) -> str:
        """The SHA-256 digest of the mesh's content; it does not depend on the machine."""
        arrays = (self.points.astype("<f8"), self.cells.astype("<i8"), self.tissue.astype("<i8"))
        content = b"".join(np.ascontiguousarray(a).tobytes() for a in arrays) + "\0".join(self.names).encode()
        return hashlib.sha256(content).hexdigest()

    def moved(self, u: Float[AnyArray, "nodes 3"]) -> TetMesh:
        """Displace every node by u (mm) and return the new mesh; ValueError if a tetrahedron inverts."""
        return TetMesh.from_arrays(self.points + np.asarray(u), self.cells, self.tissue, self.names)


def signed_volumes(points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"]) -> np.ndarray:
    """Compute the volume of every tetrahedron, mm³; an inverted tetrahedron has a negative volume."""
    corner = points[cells]
    return np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6


def boundary_faces_of(cells: Int[np.ndarray, "cells 4"]) -> Int[np.ndarray, "faces 3"]:
    """Find the triangles that belong to exactly one tetrahedron; their normals point outwards."""
    faces = cells[:, FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]


def faces_across(cells: Int[np.ndarray, "cells 4"]) -> Int[np.ndarray, "cells 4"]:
    """Find the neighbour of each tetrahedron across the face opposite to each corner; −1 if there is none."""
    face, same_face = _shared_faces(cells).T
    across = np.full(4 * len(cells), -1)
    across[face], across[same_face] = same_face // 4, face // 4
    return across.reshape(-1, 4)


def _shared_faces(cells: Int[np.ndarray, "cells 4"]) -> Int[np.ndarray, "pairs 2"]:
    """Find the pairs of identical faces; the face 4 c + a of cell c lies opposite to its corner a."""
    faces = np.sort(cells[:, FACES].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    shared = np.flatnonzero((faces[order[1:]] == faces[order[:-1]]).all(axis=1))
    return np.stack([order[shared], order[shared + 1]], axis=1)


def _require_shapes(points: np.ndarray, cells: np.ndarray, tissue: np.ndarray) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points must have shape (n, 3), got {points.shape}")
    if cells.ndim != 2 or cells.shape[1] != 4 or len(cells) == 0:
        raise InputError(f"cells must have shape (m, 4) with m > 0, got {cells.shape}")
    if tissue.shape != (len(cells),):
        raise InputError(f"tissue must have shape ({len(cells)},), one entry per cell, got {tissue.shape}")
    if not np.issubdtype(cells.dtype, np.integer) or not np.issubdtype(tissue.dtype, np.integer):
        raise InputError(f"cells and tissue must be integers, got {cells.dtype} and {tissue.dtype}")
