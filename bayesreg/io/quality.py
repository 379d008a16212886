"""Checks of a mesh: its topology, the shapes of its tetrahedra, and the volumes of its tissues."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from bayesreg.image import Image
from bayesreg.io.domain import MeshError, millilitres, place
from bayesreg.mesh import TetMesh, signed_volumes

EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
LEAST_MEAN_RATIO = 0.05
# The largest error of a volume, relative to the volume of Ω, is this times the edge length over the cube root of that
# volume: the mesh shows an interface to within a fraction of an edge length, and loses thinner parts.
VOLUME_TOLERANCE = 0.75


class MeshQuality(NamedTuple):
    """The measured qualities of a mesh.

    Attributes
    ----------
    nodes, cells, boundary_nodes : int
    genus : int
        Number of handles of the boundary surface; 0 for a ball.
    edge_length : float
        Median length of the edges, mm.
    mean_ratio : float
        Least 12 (3V)^(2/3) / Σ l² over the tetrahedra; 1 is regular, 0 is flat.
    median_mean_ratio : float
    dihedral_angle : float
        Least angle between two faces of a tetrahedron, degrees.
    tissue_cells : dict
        Number of tetrahedra by tissue name.
    tissue_volumes, label_volumes : dict
        Volumes in the mesh and in the labels, mm³, by tissue name.
    volume_tolerance : float
        Largest allowed difference of the two volumes, mm³.
    """

    nodes: int
    cells: int
    boundary_nodes: int
    genus: int
    edge_length: float
    mean_ratio: float
    median_mean_ratio: float
    dihedral_angle: float
    tissue_cells: dict[str, int]
    tissue_volumes: dict[str, float]
    label_volumes: dict[str, float]
    volume_tolerance: float


def check_mesh(mesh: TetMesh, labels: Image) -> MeshQuality:
    """Check a mesh against the labels from which it was made, and measure its quality.

    Parameters
    ----------
    mesh : TetMesh
        The mesh; its construction has checked the orientation of the tetrahedra.
    labels : Image
        0 outside Ω, 1 + index into the mesh's names inside, from `domain_labels`.

    Returns
    -------
    MeshQuality

    Raises
    ------
    MeshError
        If the mesh has several parts, its boundary is not one closed manifold surface, a tetrahedron is nearly flat
        (mean ratio below 0.05), a tissue has no tetrahedron, or the volume of Ω or a tissue differs from that of its
        labels by more than 0.75 h |Ω|^(2/3), with h the median edge length.
    """
    genus = check_topology(mesh)
    ratio = mean_ratio(mesh.points, mesh.cells)
    if ratio.min() < LEAST_MEAN_RATIO:
        raise MeshError(
            f"tetrahedron {ratio.argmin()} is nearly flat: mean ratio {ratio.min():.3g}, least {LEAST_MEAN_RATIO}"
        )
    quality = _measure(mesh, labels, ratio, genus)
    _check_tissues(quality, labels)
    return quality


def check_topology(mesh: TetMesh) -> int:
    """Check the topology of a mesh, and return the genus of its boundary.

    Raises
    ------
    MeshError
        If the mesh has several parts, or its boundary is not one closed manifold surface.
    """
    _check_connected(mesh)
    return _check_boundary(mesh)


def mean_ratio(points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"]) -> Float[np.ndarray, "cells"]:
    """Compute the mean ratio of every tetrahedron, 12 (3V)^(2/3) / Σ l² (Liu and Joe, 1994).

    A regular tetrahedron has 1; a flat or inverted one has 0.
    """
    volume = np.maximum(signed_volumes(points, cells), 0)
    return 12 * np.cbrt(3 * volume) ** 2 / (edge_lengths(points, cells) ** 2).sum(axis=1)


def edge_lengths(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"]
) -> Float[np.ndarray, "cells 6"]:
    """Compute the lengths of the edges of every tetrahedron, mm."""
    ends = points[cells[:, EDGES]]
    return np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)


def dihedral_angles(
    points: Float[np.ndarray, "nodes 3"], cells: Int[np.ndarray, "cells 4"]
) -> Float[np.ndarray, "cells 6"]:
    """Compute the angles between the faces of every tetrahedron, degrees."""
    corner = points[cells]
    # The gradients of the barycentric coordinates are the inward normals of the faces.
    inverse = np.linalg.inv(corner[:, 1:] - corner[:, :1])
    normal = np.concatenate([-inverse.sum(axis=2, keepdims=True), inverse], axis=2).transpose(0, 2, 1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = (normal[:, EDGES[:, 0]] * normal[:, EDGES[:, 1]]).sum(axis=-1)
    return np.degrees(np.arccos(np.clip(-cosine, -1, 1)))


def _check_connected(mesh: TetMesh) -> None:
    components = _count_parts(len(mesh.points), mesh.cells[:, EDGES].reshape(-1, 2))
    if components > 1:
        raise MeshError(f"the mesh has {components} separate parts, expected one")


def _check_boundary(mesh: TetMesh) -> int:
    """Check that the boundary is one closed manifold surface, and return its genus."""
    faces = mesh.boundary_faces
    for places, kind in ((crowded_edges(faces), "edges"), (pinched_nodes(faces)[:, None], "nodes")):
        if len(places):
            where = ", ".join(f"{x:.0f}" for x in mesh.points[places[0]].mean(axis=0))
            raise MeshError(f"the boundary touches itself at {len(places)} {kind}, the first at ({where}) mm")
    edges = np.unique(_edges(faces), axis=0)
    nodes, index = np.unique(edges, return_inverse=True)
    components = _count_parts(len(nodes), index.reshape(-1, 2))
    if components > 1:
        raise MeshError(f"the boundary has {components} separate surfaces, expected one: the mesh has cavities")
    return (2 - (len(nodes) - len(edges) + len(faces))) // 2


def crowded_edges(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "edges 2"]:
    """Find the edges of a closed surface that belong to more than two of its faces."""
    edges, count = np.unique(_edges(faces), axis=0, return_counts=True)
    return edges[count != 2]


def pinched_nodes(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "nodes"]:
    """Find the nodes of a closed surface around which its faces form more than one ring; none if an edge is crowded.

    Corners of faces are linked across shared edges; the linked corners of a node are one part on a manifold.

    Parameters
    ----------
    faces : (m, 3) array
        Consistently oriented.
    """
    if len(crowded_edges(faces)):
        return np.zeros(0, int)
    number = np.arange(faces.size).reshape(-1, 3)
    # Each half-edge (a → b) of one face meets (b → a) of another, so that their corners at a and at b are neighbours.
    half = np.concatenate(
        [np.stack([faces[:, i], faces[:, j], number[:, i], number[:, j]], axis=1) for i, j in ((0, 1), (1, 2), (2, 0))]
    )
    forward = half[half[:, 0] < half[:, 1]]
    backward = half[half[:, 0] > half[:, 1]][:, (1, 0, 3, 2)]
    forward, backward = (half_edge[np.lexsort((half_edge[:, 1], half_edge[:, 0]))] for half_edge in (forward, backward))
    links = np.concatenate([np.stack([forward[:, k], backward[:, k]], axis=1) for k in (2, 3)])
    rings = np.unique(np.column_stack([faces.ravel(), _parts(faces.size, links)]), axis=0)
    nodes, count = np.unique(rings[:, 0], return_counts=True)
    return nodes[count > 1]


def _edges(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "edges 2"]:
    """List the edges of faces, each once for every face."""
    return np.sort(faces[:, [(0, 1), (1, 2), (2, 0)]].reshape(-1, 2), axis=1)


def _parts(nodes: int, links: Int[np.ndarray, "links 2"]) -> Int[np.ndarray, "nodes"]:
    """Number the connected parts of a graph, and return the number for each node."""
    graph = sparse.coo_matrix((np.ones(len(links)), (links[:, 0], links[:, 1])), (nodes, nodes))
    return connected_components(graph, directed=False)[1]


def _count_parts(nodes: int, links: Int[np.ndarray, "links 2"]) -> int:
    return int(_parts(nodes, links).max()) + 1


def _measure(mesh: TetMesh, labels: Image, ratio: Float[np.ndarray, "cells"], genus: int) -> MeshQuality:
    count = len(mesh.names)
    cells = np.bincount(mesh.tissue, minlength=count)
    volumes = np.bincount(mesh.tissue, mesh.volumes, minlength=count)
    voxels = np.bincount(np.asarray(labels.voxels).ravel(), minlength=count + 1)[1 : count + 1]
    edge = float(np.median(edge_lengths(mesh.points, mesh.cells)))
    expected = voxels * labels.voxel_volume
    return MeshQuality(
        nodes=len(mesh.points),
        cells=len(mesh.cells),
        boundary_nodes=len(mesh.boundary),
        genus=genus,
        edge_length=edge,
        mean_ratio=float(ratio.min()),
        median_mean_ratio=float(np.median(ratio)),
        dihedral_angle=float(dihedral_angles(mesh.points, mesh.cells).min()),
        tissue_cells=dict(zip(mesh.names, cells.tolist(), strict=True)),
        tissue_volumes=dict(zip(mesh.names, volumes.tolist(), strict=True)),
        label_volumes=dict(zip(mesh.names, expected.tolist(), strict=True)),
        volume_tolerance=float(VOLUME_TOLERANCE * edge * expected.sum() ** (2 / 3)),
    )


def _check_tissues(quality: MeshQuality, labels: Image) -> None:
    for label, (name, count) in enumerate(quality.tissue_cells.items(), start=1):
        if count == 0:
            voxels = np.asarray(labels.voxels) == label
            where = f", its {millilitres(labels, voxels)} {place(labels, voxels)}," if voxels.any() else ""
            raise MeshError(f"no tetrahedron is {name}: the tissue{where} is too thin for this edge length")
    volumes = {**quality.tissue_volumes, "all": sum(quality.tissue_volumes.values())}
    expected = {**quality.label_volumes, "all": sum(quality.label_volumes.values())}
    for name, volume in volumes.items():
        if abs(volume - expected[name]) > quality.volume_tolerance:
            raise MeshError(
                f"the mesh holds {volume / 1000:.1f} ml of {name}, the labels {expected[name] / 1000:.1f} ml; "
                f"they may differ by {quality.volume_tolerance / 1000:.1f} ml at this edge length"
            )
