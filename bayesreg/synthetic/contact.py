"""Minimise the elastic energy of a body beside an obstacle, which its boundary nodes must not enter.

Minimise ½ uᵀKu over u, with u given at the held nodes and gap(p + u) ≥ floor at the other boundary nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_limits

from bayesreg.mesh import TetMesh

# Load steps before the last end at this accuracy, mm, or after this number of quadratic programs.
_ROUGHLY = 0.1
_ITERATIONS_OF_A_PARTIAL_LOAD = 10

Gap = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class EnergyMinimum(NamedTuple):
    """A displacement of least energy, and its errors in the conditions of optimality.

    Attributes
    ----------
    u : (n, 3) array
        Displacement of every node, mm.
    force : (n,) array
        Contact force along the gradient of the gap (the multiplier): positive, or zero at a node without contact.
    violation : float
        The largest depth of a node below the floor of its gap, or height of a node with a contact force above it, mm.
    stationarity : float
        The largest unbalanced force at a node that is not held: K u minus the contact forces, each component divided
        by its diagonal entry of K, mm.
    iterations : int
        The number of solved quadratic programs.
    converged : bool
        Whether violation and stationarity are below the tolerance.
    """

    u: Float[np.ndarray, "nodes 3"]
    force: Float[np.ndarray, "nodes"]
    violation: float
    stationarity: float
    iterations: int
    converged: bool


class _State(NamedTuple):
    u: np.ndarray  # (n, 3)
    force: np.ndarray  # (o,) multipliers of the nodes that may touch
    penalty: np.ndarray  # (o,) weights of the ℓ1 penalty, at least the multipliers
    direction: np.ndarray  # (n, 3) direction of the last step; zero if its length was not one


class ContactProblem:
    """The problem of least elastic energy with some nodes held and the other boundary nodes outside an obstacle.

    The method is sequential quadratic programming. The energy is quadratic, so that each step only replaces the gap by
    its tangent planes, and solves for the contact forces by the compliance of the boundary nodes. A line search on the
    exact ℓ1 penalty ensures descent. The held nodes are moved to their given displacements in several steps, so that
    contact begins gradually. If there are several minima, the result is the one that these steps reach.

    Parameters
    ----------
    mesh : TetMesh
    stiffness : (3n, 3n) sparse matrix
        See `bayesreg.fem.elasticity.stiffness`.
    held : (h,) int array
        At least three nodes that do not lie on one line; otherwise the body could rotate.
    held_u : (h, 3) array
        The displacements of the held nodes, mm.
    gap : callable
        Maps points (k, 3) to their distances (k,) from the obstacle, mm, and the gradients (k, 3) of the distances.
    """

    def __init__(
        self,
        mesh: TetMesh,
        stiffness: scipy.sparse.csr_matrix,
        held: Int[np.ndarray, "held"],
        held_u: Float[np.ndarray, "held 3"],
        gap: Gap,
    ) -> None:
        self.points, self.stiffness, self.gap = mesh.points, stiffness, gap
        self.nodes = np.setdiff1d(mesh.boundary, held)
        self._size = float(np.ptp(mesh.points, axis=0).max())
        self._compliance = _Compliance(stiffness, held, self.nodes)
        pushed = np.zeros_like(mesh.points)
        pushed[held] = held_u
        self._free = pushed - self._compliance.solve(stiffness @ pushed.ravel())

    # On a busy machine a second thread slowed the factorisation of matrices of 100 rows by a factor of 200.
    @threadpool_limits.wrap(limits=1, user_api="blas")
    def solve(
        self,
        floor: Float[np.ndarray, "nodes"],
        start: EnergyMinimum | None = None,
        tolerance: float = 1e-6,
        load_steps: int = 5,
        max_iterations: int = 400,
    ) -> EnergyMinimum:
        """Find the displacement of least energy.

        Parameters
        ----------
        floor : (n,) array
            The least gap of each boundary node, mm; entries of other nodes are ignored.
        start : EnergyMinimum, optional
            A solution for other floors, from which the search begins.
        tolerance : float, default 1e-6
            The tolerance for violation and stationarity, mm.
        load_steps : int, default 5
            The number of steps that move the held nodes; ignored with a `start`.
        max_iterations : int, default 400
            The largest number of quadratic programs in all load steps together.
        """
        floor, used = floor[self.nodes], 0
        if start is None:
            state = self._state(np.zeros_like(self.points), np.zeros(len(self.points)))
        else:
            state, load_steps = self._state(start.u, start.force), 0
        for step in range(load_steps):
            state = state._replace(u=state.u + self._free / load_steps)
            load = (step + 1) / load_steps
            state, count = self._iterate(state, floor, load, _ROUGHLY, _ITERATIONS_OF_A_PARTIAL_LOAD)
            used += count
        state, count = self._iterate(state, floor, 1.0, tolerance / 10, max_iterations - used)
        return self._result(state, floor, used + count, tolerance)

    def _state(self, u: np.ndarray, force: np.ndarray) -> _State:
        nodal = force[self.nodes]
        return _State(u, nodal, 1.5 * nodal, np.zeros_like(u))

    def _iterate(
        self, state: _State, floor: np.ndarray, load: float, tolerance: float, limit: int
    ) -> tuple[_State, int]:
        """Step until a step is shorter than the tolerance (mm) or longer than the body; also return the step count."""
        for count in range(1, limit + 1):
            after, step_length = self._step(state, floor, load)
            if not step_length < self._size:
                return state, count
            state = after
            if step_length < tolerance:
                return state, count
        return state, limit

    def _step(self, state: _State, floor: np.ndarray, load: float) -> tuple[_State, float]:
        """Solve one quadratic program and do a line search; also return the largest distance to its solution, mm."""
        gap, normal = self.gap((self.points + state.u)[self.nodes])
        force = self._contact_forces(state, gap - floor, normal, load)
        direction = load * self._free + self._compliance.solve(self._spread(force, normal)) - state.u
        penalty = np.maximum(state.penalty, 1.5 * force)
        first = _stretch(direction, state.direction)
        length = self._line_search(state.u, direction, penalty, floor, gap, first)
        next_direction = direction if length == 1 else np.zeros_like(direction)
        return _State(state.u + length * direction, force, penalty, next_direction), float(np.abs(direction).max())

    def _result(self, state: _State, floor: np.ndarray, used: int, tolerance: float) -> EnergyMinimum:
        gap, normal = self.gap((self.points + state.u)[self.nodes])
        out_of_balance = self.stiffness @ state.u.ravel() - self._spread(state.force, normal)
        scaled = (out_of_balance / self.stiffness.diagonal())[self._compliance.free]
        stationarity = float(np.abs(scaled).max())
        lifted = np.abs(gap - floor)[state.force > 0].max(initial=0.0)
        violation = float(max(lifted, (floor - gap).max(initial=0.0)))
        force = np.zeros(len(self.points))
        force[self.nodes] = state.force
        return EnergyMinimum(state.u, force, violation, stationarity, used, max(violation, stationarity) < tolerance)

    def _spread(self, force: np.ndarray, normal: np.ndarray) -> np.ndarray:
        nodal = np.zeros_like(self.points)
        nodal[self.nodes] = force[:, None] * normal
        return nodal.ravel()

    def _contact_forces(self, state: _State, slack: np.ndarray, normal: np.ndarray, load: float) -> np.ndarray:
        """Solve for the multipliers of the quadratic program; its working set grows until no node crosses its plane."""
        offset = slack + (normal * (load * self._free - state.u)[self.nodes]).sum(axis=1)
        force = np.zeros(len(self.nodes))
        # A node in a region where the gap has no gradient has no tangent plane.
        steep = np.abs(normal).max(axis=1) > 1e-6
        working = steep & ((state.force > 0) | (offset < 0))
        while True:
            index = np.flatnonzero(working)
            matrix = np.einsum("ai,aibj,bj->ab", normal[index], self._compliance.among(index), normal[index])
            force[index] = complementarity(matrix, -offset[index], state.force[index] > 0)
            normal_displacement = (normal * self._compliance.response(index, force[index, None] * normal[index])).sum(
                axis=1
            )
            crossed = steep & ~working & (offset + normal_displacement < -1e-9)
            if not crossed.any():
                return force
            working |= crossed

    def _line_search(
        self,
        u: np.ndarray,
        direction: np.ndarray,
        penalty: np.ndarray,
        floor: np.ndarray,
        gap: np.ndarray,
        first: float,
    ) -> float:
        """Find a step length that decreases the energy plus the penalised violation (Armijo)."""
        slope = float(direction.ravel() @ (self.stiffness @ u.ravel()))
        curvature = float(direction.ravel() @ (self.stiffness @ direction.ravel()))
        below = float(penalty @ np.maximum(floor - gap, 0))
        expected = slope - below
        length = first
        while length > 1e-3:
            trial, _ = self.gap((self.points + u + length * direction)[self.nodes])
            change = length * slope + length**2 / 2 * curvature
            change += float(penalty @ np.maximum(floor - trial, 0)) - below
            if change <= 1e-4 * length * expected + 1e-12 * abs(slope):
                break
            length /= 2
        return length


def _stretch(direction: np.ndarray, previous: np.ndarray) -> float:
    """Return Aitken's step length if two steps are nearly parallel, as terms of a geometric series; otherwise 1.

    Convergence is linear, because the tangent planes ignore the curvature of the obstacle.
    """
    dot, square, last = (float((a * b).sum()) for a, b in ((direction, previous), (direction,) * 2, (previous,) * 2))
    in_line = dot**2 > 0.95 * square * last > 0
    return 1 / (1 - dot / last) if in_line and -1 < dot / last < 0.98 else 1.0


class _Compliance:
    """K⁻¹ with the held nodes fixed: one factorisation; the column of a node is computed when the node has contact."""

    def __init__(self, stiffness: scipy.sparse.csr_matrix, held: np.ndarray, nodes: np.ndarray) -> None:
        degrees = np.arange(stiffness.shape[0]).reshape(-1, 3)
        self.free = np.delete(degrees, held, axis=0).ravel()
        self.rows = degrees[nodes].ravel()
        # The stiffness of a fluid and a solid differ by seven decades; scaling to a unit diagonal balances the factor.
        self.scale = 1 / np.sqrt(stiffness.diagonal()[self.free])
        scaled = scipy.sparse.diags(self.scale) @ stiffness[self.free][:, self.free] @ scipy.sparse.diags(self.scale)
        self.factor = splu(
            scaled.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        self.position = np.full(len(nodes), -1)
        self.columns = np.zeros((len(self.rows), 0))

    def solve(self, force: np.ndarray) -> np.ndarray:
        """Compute the displacement (n, 3) by nodal forces (3n,); the held nodes do not move."""
        result = np.zeros_like(force)
        result[self.free] = self._solve_free(force[self.free, None])[:, 0]
        return result.reshape(-1, 3)

    def among(self, index: np.ndarray) -> np.ndarray:
        """Compute the displacements (k, 3, k, 3) of the nodes of `index` by unit forces on these nodes."""
        self._add(index[self.position[index] < 0])
        rows, columns = (3 * i[:, None] + np.arange(3) for i in (index, self.position[index]))
        return self.columns[rows[:, :, None, None], columns]

    def response(self, index: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Compute the displacement (o, 3) of every node that may touch, by forces (k, 3) on the nodes of `index`."""
        all_forces = np.zeros((self.columns.shape[1] // 3, 3))
        all_forces[self.position[index]] = force
        return (self.columns @ all_forces.ravel()).reshape(-1, 3)

    def _add(self, index: np.ndarray) -> None:
        """Compute the columns of the compliance for forces on the nodes of `index`."""
        if not len(index):
            return
        degrees = self.rows.reshape(-1, 3)[index].ravel()
        unit = np.zeros((len(self.free), len(degrees)))
        unit[np.searchsorted(self.free, degrees), np.arange(len(degrees))] = 1
        self.position[index] = self.columns.shape[1] // 3 + np.arange(len(index))
        new = self._solve_free(unit)[np.searchsorted(self.free, self.rows)]
        self.columns = np.concatenate([self.columns, new], axis=1)

    def _solve_free(self, force: np.ndarray) -> np.ndarray:
        return self.scale[:, None] * self.factor.solve(self.scale[:, None] * force)


def complementarity(
    matrix: Float[np.ndarray, "k k"], demand: Float[np.ndarray, "k"], start: Bool[np.ndarray, "k"]
) -> Float[np.ndarray, "k"]:
    """Solve x ≥ 0, A x ≥ b, xᵀ(A x − b) = 0 for a symmetric positive definite A.

    The method is block principal pivoting (Júdice and Pires, 1994): guess the support, solve, and exchange all entries
    of the wrong sign. If their number does not decrease, exchange only the last one (Murty); this rule always ends.

    Parameters
    ----------
    matrix : (k, k) array
        A.
    demand : (k,) array
        b.
    start : (k,) bool array
        First guess of the support of x.
    """
    size = 1 / np.sqrt(np.diag(matrix))
    matrix, demand = size[:, None] * matrix * size, size * demand
    active, fewest, patience = start.copy(), len(start) + 1, 3
    slack_tolerance = 1e-11 * max(1.0, np.abs(demand).max(initial=0.0))
    while True:
        x = np.zeros(len(start))
        if active.any():
            x[active] = cho_solve(cho_factor(matrix[np.ix_(active, active)]), demand[active])
        wrong = np.where(active, x < 0, matrix @ x - demand < -slack_tolerance)
        count = int(wrong.sum())
        if count == 0:
            return size * x
        patience = 3 if count < fewest else patience - 1
        fewest = min(fewest, count)
        exchange = wrong if patience > 0 else np.arange(len(wrong)) == np.flatnonzero(wrong)[-1]
        active ^= exchange
