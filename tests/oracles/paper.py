"""The paper's formulas, transcribed plainly in NumPy and SciPy: the independent route for the tests.

Equation numbers are those of Risholm, Samset and Wells (2010). Written to be read against the paper, slow on
purpose (loops over elements), and sharing no code with the software.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage, sparse, stats
from scipy.sparse.linalg import splu

# ---------------------------------------------------------------------------------------------- elements


def shape_gradients(corners: np.ndarray) -> np.ndarray:
    """(4, 3): gradient of each barycentric coordinate, from N_a(x) = c_a0 + c_a · x, N_a(x_b) = δ_ab."""
    vandermonde = np.column_stack([np.ones(4), corners])
    return np.linalg.inv(vandermonde)[1:].T


def volume(corners: np.ndarray) -> float:
    return float(np.linalg.det(np.column_stack([np.ones(4), corners])) / 6)


def strain_matrix(corners: np.ndarray) -> np.ndarray:
    """B, (6, 12), below Eq. (4), for the nodal values (u_0, v_0, w_0, u_1, …)."""
    B = np.zeros((6, 12))
    for a, (dx, dy, dz) in enumerate(shape_gradients(corners)):
        B[:, 3 * a : 3 * a + 3] = np.array(
            [[dx, 0, 0], [0, dy, 0], [0, 0, dz], [dy, dx, 0], [dz, 0, dx], [0, dz, dy]],
        )
    return B


def material_matrix(lam: float, mu: float) -> np.ndarray:
    """C of Eq. (5)."""
    C = np.zeros((6, 6))
    C[:3, :3] = lam
    return C + np.diag([2 * mu, 2 * mu, 2 * mu, mu, mu, mu])


def element_stiffness(corners: np.ndarray, lam: float, mu: float) -> np.ndarray:
    """K_e of Eq. (6), (12, 12)."""
    B = strain_matrix(corners)
    return volume(corners) * B.T @ material_matrix(lam, mu) @ B


def stiffness(points: np.ndarray, cells: np.ndarray, lam: np.ndarray, mu: np.ndarray) -> sparse.csc_matrix:
    """K of Eq. (7), (3n, 3n), node-major; lam, mu by element."""
    rows, columns, values = [], [], []
    for cell, element_lam, element_mu in zip(cells, lam, mu, strict=True):
        dofs = (3 * cell[:, None] + np.arange(3)).ravel()
        rows.append(np.repeat(dofs, 12))
        columns.append(np.tile(dofs, 12))
        values.append(element_stiffness(points[cell], element_lam, element_mu).ravel())
    size = 3 * len(points)
    triplets = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.coo_matrix(triplets, shape=(size, size)).tocsc()


def elastic_potential(points: np.ndarray, cells: np.ndarray, lam: np.ndarray, mu: np.ndarray, u: np.ndarray) -> float:
    """Eq. (2), the elastic potential, written out."""
    total = 0.0
    for cell, element_lam, element_mu in zip(cells, lam, mu, strict=True):
        gradient = shape_gradients(points[cell]).T @ u[cell]  # gradient[j, k] = ∂_j u_k
        shear = sum((gradient[j, k] + gradient[k, j]) ** 2 for j in range(3) for k in range(3))
        density = element_mu / 4 * shear + element_lam / 2 * np.trace(gradient) ** 2
        total += volume(points[cell]) * density
    return total


def solve_unknown(K: sparse.csc_matrix, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Eq. (7) without forces: u (n, 3) with the rows of `known` nodes given, by sparse LU."""
    u = np.zeros((K.shape[0] // 3, 3))
    u[known] = values
    unknown = np.setdiff1d(np.arange(len(u)), known)
    if len(unknown):
        i = (3 * unknown[:, None] + np.arange(3)).ravel()
        k = (3 * np.asarray(known)[:, None] + np.arange(3)).ravel()
        load = -K[i][:, k] @ u[known].ravel()
        u[unknown] = splu(K[i][:, i].tocsc()).solve(load).reshape(-1, 3)
    return u


# -------------------------------------------------------------------------------------------- quadrature

A4, B4 = (5 + 3 * np.sqrt(5)) / 20, (5 - np.sqrt(5)) / 20
FOUR_POINTS = np.full((4, 4), B4) + np.eye(4) * (A4 - B4)


def eight_children(diagonal: int = 0) -> np.ndarray:
    """(8, 4, 4): barycentric corners of the children of a tetrahedron split at its edge midpoints.

    `diagonal` 0, 1, 2 joins the midpoints of edges 01 and 23, 02 and 13, or 03 and 12.
    """
    e = np.eye(4)
    corner = [[e[i]] + [(e[i] + e[j]) / 2 for j in range(4) if j != i] for i in range(4)]
    pairs = [((0, 1), (2, 3)), ((0, 2), (1, 3)), ((0, 3), (1, 2))]
    ends = [(e[i] + e[j]) / 2 for i, j in pairs.pop(diagonal)]
    (p, q), (r, s) = [[(e[i] + e[j]) / 2 for i, j in pair] for pair in pairs]
    inner = [[*ends, *side] for side in ((p, r), (r, q), (q, s), (s, p))]
    return np.array(corner + inner)


def reference_rule(name: str, diagonal: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric points (q, 4) and weights as fractions of the volume (q,)."""
    if name == "gauss4":
        return FOUR_POINTS, np.full(4, 1 / 4)
    return np.vstack([FOUR_POINTS @ child for child in eight_children(diagonal)]), np.full(32, 1 / 32)


def mesh_rule(
    points: np.ndarray, cells: np.ndarray, name: str, diagonal: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the whole mesh: cell (q,), barycentric coordinates (q, 4), weight mm³ (q,)."""
    barycentric, fraction = reference_rule(name, diagonal)
    volumes = np.array([volume(points[cell]) for cell in cells])
    owner = np.repeat(np.arange(len(cells)), len(fraction))
    return owner, np.tile(barycentric, (len(cells), 1)), (volumes[:, None] * fraction).ravel()


def voxel_rule(
    points: np.ndarray, cells: np.ndarray, shape: tuple[int, ...], affine: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Voxel centres inside the mesh, each with the volume of a voxel."""
    indices = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    centres = np.column_stack([indices @ affine[:3, :3].T + affine[:3, 3], np.ones(len(indices))])
    taken = np.zeros(len(centres), bool)
    owner, barycentric = [], []
    for c, cell in enumerate(cells):
        coordinates = centres @ np.linalg.inv(np.column_stack([points[cell], np.ones(4)]))
        inside = (coordinates >= 0).all(axis=1) & ~taken
        taken |= inside
        owner.append(np.full(inside.sum(), c))
        barycentric.append(coordinates[inside])
    weight = abs(np.linalg.det(affine[:3, :3]))
    return np.concatenate(owner), np.vstack(barycentric), np.full(taken.sum(), weight)


# ------------------------------------------------------------------------------------------------ images


def interpolate(voxels: np.ndarray, affine: np.ndarray, where: np.ndarray, method: str) -> np.ndarray:
    """Values at world points (q, 3); the nearest value outside the grid."""
    inverse = np.linalg.inv(affine)
    indices = where @ inverse[:3, :3].T + inverse[:3, 3]
    indices = np.clip(indices, 0, np.array(voxels.shape) - 1.0)
    order, mode = {"linear": (1, "nearest"), "cubic": (3, "mirror")}[method]
    return ndimage.map_coordinates(np.asarray(voxels, float), indices.T, order=order, mode=mode)


def in_skull(skull: np.ndarray, affine: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Which world points lie in a forbidden voxel, or off the grid (nearest voxel)."""
    inverse = np.linalg.inv(affine)
    indices = np.rint(where @ inverse[:3, :3].T + inverse[:3, 3]).astype(int)
    off = ((indices < 0) | (indices >= skull.shape)).any(axis=1)
    inside = np.clip(indices, 0, np.array(skull.shape) - 1)
    return off | (skull[tuple(inside.T)] != 0)


# ----------------------------------------------------------------------------------------------- density


def rigid_modes(points: np.ndarray) -> np.ndarray:
    """(3b, 6): orthonormal basis of translations and infinitesimal rotations about the centroid."""
    centred = points - points.mean(axis=0)
    modes = []
    for axis in np.eye(3):
        modes.append(np.tile(axis, len(points)))
    for axis in np.eye(3):
        modes.append(np.cross(axis, centred).ravel())
    return np.linalg.qr(np.array(modes).T)[0]


@dataclass
class Prior:
    """Beta(A, B) scaled to [r1, r2]; A = B = 1 and r2 = ∞ is flat on [r1, ∞)."""

    A: float = 1.0
    B: float = 1.0
    r1: float = 0.0
    r2: float = np.inf

    def logpdf(self, x: float) -> float:
        if np.isinf(self.r2):
            return 0.0 if x >= self.r1 else -np.inf
        return float(stats.beta.logpdf(x, self.A, self.B, loc=self.r1, scale=self.r2 - self.r1))


@dataclass
class Paper:
    """log p(u, λ, μ | m) of Eqs. (9), (11), (12), up to a constant.

    lam and mu are by element, by tissue, or uniform, as their length says; `free_lam` and `free_mu` are the
    entries that have a prior (default: all of them).
    """

    points: np.ndarray
    cells: np.ndarray
    tissue: np.ndarray
    fixed: tuple[np.ndarray, np.ndarray]
    moving: tuple[np.ndarray, np.ndarray]
    sampled: np.ndarray
    held: Mapping[int, tuple[float, float, float]] = field(default_factory=dict)
    t_similarity: float = 0.05
    t_elastic: float = 1e4
    quadrature: str = "gauss4"
    interpolation: str = "linear"
    rigid_sd: float | None = None
    prior_lam: Prior = field(default_factory=Prior)
    prior_mu: Prior = field(default_factory=Prior)
    free_lam: list[int] | None = None
    free_mu: list[int] | None = None
    skull: tuple[np.ndarray, np.ndarray] | None = None
    diagonal: int = 0

    def __post_init__(self) -> None:
        self.known = np.concatenate([np.asarray(self.sampled), np.array(sorted(self.held), int)]).astype(int)
        if self.quadrature == "voxels":
            self.rule = voxel_rule(self.points, self.cells, self.fixed[0].shape, self.fixed[1])
        else:
            self.rule = mesh_rule(self.points, self.cells, self.quadrature, self.diagonal)

    def by_element(self, values: np.ndarray) -> np.ndarray:
        values = np.asarray(values, float)
        if len(values) == len(self.cells):
            return values
        return np.full(len(self.cells), values[0]) if len(values) == 1 else values[self.tissue]

    def stiffness(self, lam: np.ndarray, mu: np.ndarray) -> sparse.csc_matrix:
        return stiffness(self.points, self.cells, self.by_element(lam), self.by_element(mu))

    def displacement(self, u_sampled: np.ndarray, lam: np.ndarray, mu: np.ndarray) -> np.ndarray:
        """u at every node, (n, 3)."""
        held = np.array([self.held[k] for k in sorted(self.held)], float).reshape(-1, 3)
        return solve_unknown(self.stiffness(lam, mu), self.known, np.vstack([u_sampled, held]))

    def similarity(self, u: np.ndarray) -> float:
        """E_s, Eq. (1)."""
        owner, barycentric, weight = self.rule
        corners = self.cells[owner]
        x = np.einsum("qa,qai->qi", barycentric, self.points[corners])
        moved = x + np.einsum("qa,qai->qi", barycentric, u[corners])
        f = interpolate(*self.fixed, x, self.interpolation)
        m = interpolate(*self.moving, moved, self.interpolation)
        return float(weight @ (f - m) ** 2)

    def strain(self, u: np.ndarray, lam: np.ndarray, mu: np.ndarray) -> float:
        """E_r, Eq. (3), element by element."""
        return elastic_potential(self.points, self.cells, self.by_element(lam), self.by_element(mu), u)

    def log_rigid(self, u_sampled: np.ndarray) -> float:
        """log of the Gaussian of sd `rigid_sd` on the root-mean-square displacement of each rigid mode."""
        if self.rigid_sd is None:
            return 0.0
        coefficient = rigid_modes(self.points[self.sampled]).T @ u_sampled.ravel()
        return float(-0.5 * (coefficient**2).sum() / len(self.sampled) / self.rigid_sd**2)

    def log_prior(self, lam: np.ndarray, mu: np.ndarray) -> float:
        free_lam = range(len(lam)) if self.free_lam is None else self.free_lam
        free_mu = range(len(mu)) if self.free_mu is None else self.free_mu
        return sum(self.prior_lam.logpdf(lam[i]) for i in free_lam) + sum(self.prior_mu.logpdf(mu[i]) for i in free_mu)

    def logdensity(self, u_sampled: np.ndarray, lam: np.ndarray, mu: np.ndarray) -> float:
        lam, mu = np.asarray(lam, float), np.asarray(mu, float)
        if (lam < 0).any() or (mu < 0).any():
            return -np.inf
        if self.skull is not None and in_skull(*self.skull, self.points[self.sampled] + u_sampled).any():
            return -np.inf
        u = self.displacement(u_sampled, lam, mu)
        boltzmann = -self.similarity(u) / self.t_similarity - self.strain(u, lam, mu) / self.t_elastic
        return boltzmann + self.log_prior(lam, mu) + self.log_rigid(u_sampled)


# ------------------------------------------------------------------------------------ closed-form posterior


def schur_complement(K: sparse.csc_matrix, sampled: np.ndarray) -> np.ndarray:
    """S = K_BB − K_BI K_II⁻¹ K_IB, dense, (3b, 3b)."""
    P = extension(K, sampled)
    return P.T @ (K @ P)


def extension(K: sparse.csc_matrix, sampled: np.ndarray) -> np.ndarray:
    """(3n, 3b): all displacements as a linear function of the sampled ones."""
    size = 3 * len(sampled)
    return np.column_stack([solve_unknown(K, sampled, e.reshape(-1, 3)).ravel() for e in np.eye(size)])


class Gaussian:
    """N(mean, inverse(precision)) of u_B.ravel()."""

    def __init__(self, mean: np.ndarray, precision: np.ndarray) -> None:
        self.mean, self.precision = mean, precision
        self.covariance = np.linalg.inv(precision)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        factor = np.linalg.cholesky(self.precision)
        return self.mean + np.linalg.solve(factor.T, rng.normal(size=(len(self.mean), count))).T


def gaussian_posterior(paper: Paper, lam: np.ndarray, mu: np.ndarray, offset: float, gradient: np.ndarray) -> Gaussian:
    """Posterior of u_B at fixed (λ, μ) where the moving image is offset + gradient · x.

    The residual at a quadrature point is f(x) − offset − gradient · x − gradient · u(x), linear in u_B, so
    −log p = ‖√w (r − G u_B)‖² / T_s + ½ u_Bᵀ S u_B / T_r + ½ |Rᵀu_B|² / (b rigid_sd²).
    """
    K = paper.stiffness(lam, mu)
    P = extension(K, np.asarray(paper.sampled))
    owner, barycentric, weight = paper.rule
    corners = paper.cells[owner]
    x = np.einsum("qa,qai->qi", barycentric, paper.points[corners])
    at_points = np.zeros((len(owner), 3 * len(paper.points)))
    for a in range(4):
        for i in range(3):
            at_points[np.arange(len(owner)), 3 * corners[:, a] + i] += barycentric[:, a] * gradient[i]
    G = at_points @ P
    residual = interpolate(*paper.fixed, x, paper.interpolation) - offset - x @ gradient
    precision = 2 * (G.T * weight) @ G / paper.t_similarity + P.T @ (K @ P) / paper.t_elastic
    if paper.rigid_sd is not None:
        R = rigid_modes(paper.points[paper.sampled])
        precision = precision + R @ R.T / len(paper.sampled) / paper.rigid_sd**2
    information = 2 * (G.T * weight) @ residual / paper.t_similarity
    return Gaussian(np.linalg.solve(precision, information), (precision + precision.T) / 2)
