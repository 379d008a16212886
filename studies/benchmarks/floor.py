"""The least time that a density can take on this machine.

For every step of the algorithm, the bytes that it must read and write are divided by the measured bandwidth, and its
floating-point operations by the measured peak. The slower of the two bounds the step. The bandwidth is that of sums of
arrays of 8 MB, which stay in the last cache, like vectors of the paper's size; the peak is that of products of dense
matrices. Matrices and the voxels about a point count once for all chains, vectors once for every pass.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.fem.operators import SparseOperator
from bayesreg.model.program import Problem
from studies.benchmarks.bench_sampling import _median

DOUBLE, SINGLE, INDEX = 8, 4, 4
TAPS = 64


class Machine(NamedTuple):
    """The bandwidth of a machine in bytes per second, and its floating-point operations per second."""

    bandwidth: float
    double: float
    single: float


class Work(NamedTuple):
    """The bytes of a step, and its operations in double and in single precision."""

    bytes: float = 0.0
    double: float = 0.0
    single: float = 0.0

    def seconds(self, machine: Machine) -> float:
        """The least time of the step on a machine."""
        return max(self.bytes / machine.bandwidth, self.double / machine.double + self.single / machine.single)


def measured() -> Machine:
    """Measure the speed of this machine."""
    first, second = (jnp.full(2**20, float(k)) for k in (1, 2))
    add = jax.jit(lambda x, y: jax.lax.fori_loop(0, 32, lambda _, x: x + 1e-9 * y, x))
    matrices = [jnp.asarray(np.random.default_rng(0).normal(size=(2048, 2048)), kind) for kind in ("f8", "f4")]
    product = jax.jit(lambda x: x @ x)
    double, single = (2 * 2048**3 / _median(product, matrix) for matrix in matrices)
    return Machine(32 * 3 * first.nbytes / _median(add, first, second), double, single)


def density_work(data: Problem, chains: int, iterations: int) -> tuple[Work, Work, Work]:
    """The work of the elastic solve, of the images and of the strain energy, for all chains."""
    system, images = data.body.system, data.terms["images"]
    cells, quadrature = len(system.elements.volumes), images.quadrature
    free, points = 3 * len(system.free), len(quadrature.weights)
    hooke = Work((2 * 9 + 2) * cells * chains * DOUBLE, 30 * cells * chains)
    apply = _sum(_product(system.free_derivative, 3 * chains), hooke, _product(system.free_derivative, 3 * chains))
    inverse = Work(SINGLE * free**2, single=2 * free**2 * chains)
    # x, residual and direction are read and written; image and z are written and read.
    vectors = Work(10 * free * chains * DOUBLE, 12 * free * chains)
    load = _sum(_product(system.prescribed_derivative, 3 * chains), hooke, _product(system.free_derivative, 3 * chains))
    solve = _sum(load, inverse, *[_sum(apply, inverse, vectors)] * iterations)
    taps = Work((TAPS + 2 * chains) * points * DOUBLE, 2 * (TAPS + 16 + 4) * points * chains)
    comparison = _sum(_product(quadrature.interpolation, 3 * chains), taps)
    energies = _sum(
        _product(system.elements.derivative, 3 * chains), Work(2 * cells * chains * DOUBLE, 30 * cells * chains)
    )
    return solve, comparison, energies


def _product(operator: SparseOperator, columns: int) -> Work:
    """The work of a product of a sparse matrix and columns, which reads both once and writes the result."""
    entries, rows = operator.matrix.entries.size, operator.matrix.starts.size - 1
    inputs = operator.transposed.starts.size - 1
    return Work(entries * (DOUBLE + INDEX) + (rows + inputs) * columns * DOUBLE, 2 * entries * columns)


def _sum(*works: Work) -> Work:
    return Work(*(sum(each) for each in zip(*works, strict=True)))
