"""The displacement that a mesh cannot resolve: quadratic modes on its edges, moved by random loads.

Within a tetrahedron a smooth displacement differs from its linear interpolation by Σ_e N_e(x) a_e, up to terms of third
order in the length of the edges. The sum runs over the six edges e = ab, N_e = 4 β_a β_b with the barycentric
coordinates β, and a_e is the difference at the midpoint of the edge. Neighbouring tetrahedra share the a_e of an edge,
so that the displacement has no jumps.

The prior of random loads (`bayesreg.model.elastic.loads`) has a size for these modes, too. If the nodes and the other
edges are held, then a_e is in equilibrium with the load on its mode,

K_e a_e = q_e,    K_e = ∫ B_eᵀ D B_e dx,    q_e ~ N(0, F_e I),    F_e = r_e (s² ∫ N_e² dx + t² ∫ N_e² dA),

where K_e (3, 3) is the stiffness of the mode, s the density of the body forces and t that of the surface forces. With
V and A the volumes and areas of the tetrahedra and boundary faces at the edge, ∫ N_e² dx = 8 V / 105 and ∫ N_e² dA =
8 A / 45. On a border between tissues each tetrahedron contributes its own stiffness. r_e is the mean over both ends n
of the edge of E|q_n|² / E₀|q_n|²: the squared load of the node under the posterior over that under the prior. Loads
are larger where organs touch and smaller in a fluid, and the images tell it of the nodes.

Thus a_e ~ N(0, C_e) with C_e = F_e K_e⁻². At an end of the edge, whose length is h, the mode has the strain
4 |a_e| / h. Linear elasticity is no model of large strains, where tissue stiffens and fluid flows, so that strains have
a second prior, Normal with sd ε = 1/4: C_e becomes (F_e⁻¹ K_e² + (4 / (ε h))²)⁻¹. It matters where a tissue is very
soft.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from bayesreg.fem.elasticity import stiffness
from bayesreg.fem.elements import boundary_areas, shape_gradients
from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import Values
from bayesreg.model.state import Body
from bayesreg.types import Matrix

# The six edges of a tetrahedron and the three of a face, as pairs of corners.
EDGES, EDGES_OF_FACE = tuple(combinations(range(4), 2)), tuple(combinations(range(3), 2))
# The means of N_e² over a tetrahedron and over a face at the edge.
MEAN_SQUARE, MEAN_SQUARE_OF_FACE = 8 / 105, 8 / 45


# ε, the sd of strains beside that by the loads; and the greatest number of draws of loads that are averaged.
STRAIN, MOST_DRAWS = 0.25, 200


@dataclass(frozen=True, eq=False)
class Unresolved:
    """The distribution of the displacement that a mesh cannot resolve.

    Attributes
    ----------
    edges : (m, 6) int array
        The edges of each tetrahedron, in the order of `EDGES`.
    root : (e, 3, 3) array
        The symmetric root of the covariance C_e of each edge, mm.
    """

    edges: Int[np.ndarray, "cells 6"]
    root: Float[np.ndarray, "edges 3 3"]

    @cached_property
    def covariance(self) -> Float[np.ndarray, "edges 3 3"]:
        """C_e of each edge, mm²."""
        return self.root @ self.root

    def covariance_at(
        self, cells: Int[np.ndarray, "k"], barycentric: Float[np.ndarray, "k 4"]
    ) -> Float[np.ndarray, "k 3 3"]:
        """Compute the covariance Σ_e N_e² C_e of the displacement at points in tetrahedra, mm²; zero at nodes."""
        return np.einsum("ke,keij->kij", _modes(barycentric) ** 2, self.covariance[self.edges[cells]])

    def variance_at(
        self, cells: Int[np.ndarray, "k"], barycentric: Float[np.ndarray, "k 4"]
    ) -> Float[np.ndarray, "k 3"]:
        """Compute the diagonal of `covariance_at`, mm²."""
        variance = np.einsum("eii->ei", self.covariance)
        return np.einsum("ke,kei->ki", _modes(barycentric) ** 2, variance[self.edges[cells]])

    def turned(self, rotation: Float[np.ndarray, "3 3"]) -> Unresolved:
        """Return the distribution of the displacement after a rotation."""
        return Unresolved(self.edges, rotation @ self.root @ rotation.T)

    def draw(self, seed: tuple[int, ...]) -> Float[np.ndarray, "edges 3"]:
        """Draw a_e of every edge, mm."""
        return np.einsum("eij,ej->ei", self.root, np.random.default_rng(seed).standard_normal(self.root.shape[:2]))

    def displacement(
        self,
        amplitudes: Float[np.ndarray, "edges 3"],
        cells: Int[np.ndarray, "k"],
        barycentric: Float[np.ndarray, "k 4"],
    ) -> Float[np.ndarray, "k 3"]:
        """Compute the displacement Σ_e N_e a_e at points in tetrahedra, mm."""
        return np.einsum("ke,kei->ki", _modes(barycentric), amplitudes[self.edges[cells]])


def unresolved_in(body: Body, values: Values, draws: Float[np.ndarray, "draws nodes 3"]) -> Unresolved:
    """Make the distribution of the displacement that the mesh of a body cannot resolve.

    Only random loads give it a size; with another elastic prior it is zero.

    Parameters
    ----------
    body : Body
    values : mapping
        Values of all blocks: λ, μ, s and t are read.
    draws : (S, n, 3) array
        Draws of the displacement of every node, mm, which tell r_e. Without draws it is one.
    """
    mesh = body.mesh.mesh
    lam, mu = (np.asarray(by_cell) for by_cell in body.lame_by_cell(values))
    s, t = (float(values[name]) if name in values else 0.0 for name in ("body_load", "surface_load"))
    ratio = np.ones(len(mesh.points))
    if s and len(draws):
        expected = s**2 * mesh.nodal_volumes + t**2 * boundary_areas(mesh)
        ratio = _mean_square_loads(stiffness(mesh, lam, mu), draws) / expected
    return unresolved_displacement(mesh, lam, mu, s, t, ratio)


def _mean_square_loads(K: Matrix, draws: Float[np.ndarray, "draws nodes 3"]) -> Float[np.ndarray, "nodes"]:
    """Compute the mean square of the components of the load q = K u at every node, over some evenly spaced draws."""
    some = draws[:: max(1, -(-len(draws) // MOST_DRAWS))]
    loads = K @ some.reshape(len(some), -1).T
    return (loads**2).reshape(-1, 3 * len(some)).mean(axis=1)


def unresolved_displacement(
    mesh: TetMesh,
    lam: Float[np.ndarray, "cells"],
    mu: Float[np.ndarray, "cells"],
    body: float,
    surface: float,
    ratio: Float[np.ndarray, "nodes"],
) -> Unresolved:
    """Make the distribution of the displacement that a mesh cannot resolve.

    Parameters
    ----------
    mesh : TetMesh
    lam, mu : (m,) arrays
        λ and μ of each tetrahedron.
    body, surface : float
        s and t, in the units of `bayesreg.model.elastic.loads.RandomLoads`. With zeros there is no such displacement.
    ratio : (n,) array
        E|q_n|² / E₀|q_n|² of each node.
    """
    pairs = np.sort(np.stack([mesh.cells[:, pair] for pair in EDGES], axis=1), axis=-1)
    nodes, edges = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    edges = edges.reshape(-1, len(EDGES))
    K, volume = np.zeros((len(nodes), 3, 3)), np.zeros(len(nodes))
    gradients = shape_gradients(mesh)
    for (a, b), edge in zip(EDGES, edges.T, strict=True):
        np.add.at(K, edge, _stiffness(gradients[:, a], gradients[:, b], mesh.volumes, lam, mu))
        np.add.at(volume, edge, mesh.volumes)
    loads = body**2 * MEAN_SQUARE * volume + surface**2 * MEAN_SQUARE_OF_FACE * _areas(mesh, nodes)
    rigidity, axes = np.linalg.eigh(K)
    variances = (ratio[nodes].mean(axis=1) * loads)[:, None] / rigidity**2
    length = np.linalg.norm(mesh.points[nodes[:, 0]] - mesh.points[nodes[:, 1]], axis=1)
    variances /= 1 + variances * (4 / (STRAIN * length[:, None])) ** 2
    return Unresolved(edges, axes @ (np.sqrt(variances)[:, :, None] * np.swapaxes(axes, 1, 2)))


def _stiffness(
    of_a: Float[np.ndarray, "cells 3"],
    of_b: Float[np.ndarray, "cells 3"],
    volumes: Float[np.ndarray, "cells"],
    lam: Float[np.ndarray, "cells"],
    mu: Float[np.ndarray, "cells"],
) -> Float[np.ndarray, "cells 3 3"]:
    """Compute the stiffness ∫ (λ + μ) ∇N ∇Nᵀ + μ |∇N|² dx of the mode N = 4 β_a β_b in each tetrahedron.

    With ∇N = 4 (β_b ∇β_a + β_a ∇β_b), the means of β_a² and β_a β_b over a tetrahedron are 1/10 and 1/20.
    """
    outer = np.einsum("ci,cj->cij", of_a, of_a) + np.einsum("ci,cj->cij", of_b, of_b)
    cross = np.einsum("ci,cj->cij", of_a, of_b)
    products = 16 * volumes[:, None, None] * (outer / 10 + (cross + np.swapaxes(cross, 1, 2)) / 20)
    squares = np.trace(products, axis1=1, axis2=2)
    return (lam + mu)[:, None, None] * products + (mu * squares)[:, None, None] * np.eye(3)


def _areas(mesh: TetMesh, edges: Int[np.ndarray, "edges 2"]) -> Float[np.ndarray, "edges"]:
    """Compute the area of the boundary faces at each edge, mm²; zero inside."""
    corners = mesh.points[mesh.boundary_faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    number, total = edges @ (len(mesh.points), 1), np.zeros(len(edges))
    for pair in EDGES_OF_FACE:
        ends = np.sort(mesh.boundary_faces[:, pair], axis=1)
        np.add.at(total, np.searchsorted(number, ends @ (len(mesh.points), 1)), areas)
    return total


def _modes(barycentric: Float[np.ndarray, "k 4"]) -> Float[np.ndarray, "k 6"]:
    """Compute N_e = 4 β_a β_b of the six edges at points."""
    return np.stack([4 * barycentric[:, a] * barycentric[:, b] for a, b in EDGES], axis=1)
