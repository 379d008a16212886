"""Would steps with a frozen factor, or acceptance in two stages, make the sampler faster?

    python -m studies.benchmarks.stages RUN [--chains 4] [--proposals 400]

RUN is the folder of a finished run with three tissues; the chains start at draws of it. Times are medians of nine.

Frozen factor: at fixed (λ, μ) a matrix R of each chain gives the free nodes from the sampled ones, and the strain
energy is a quadratic form S. The program times a gradient with known R and S, the usual gradient with solve and
adjoint, and the computation of R and S by LAPACK. The time of this computation over the time that a gradient saves is
the number of gradients for which each (λ, μ) would have to serve.

Two stages: a proposal of the paper's kernel is first tested with an approximate density, and evaluated in full if it
passes (Christen and Fox 2005). The approximate density makes one iteration of the solve, from the present displacement
of the chain. Chains run side by side, so that the second stage runs if the proposal of any chain passes. The gain is at
most full / (first + passed · full) times accepted in two stages / accepted.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

import bayesreg as br
from bayesreg.fem import equilibrium
from bayesreg.fem.elasticity import stiffness, unknowns_of
from bayesreg.inference.samplers.random_walk import _normal_step
from bayesreg.io import store
from bayesreg.io.run_folder import RunFolder
from bayesreg.model.coordinates import complete
from bayesreg.model.posterior import Posterior
from bayesreg.workflow.assembly import posterior_of
from studies.benchmarks.bench_effective_draws import STEPS, estimands_of
from studies.benchmarks.parts import timed


def main() -> None:
    """Read the command line, and print both estimates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--proposals", type=int, default=400)
    arguments = parser.parse_args()
    posterior = posterior_of(br.load_config(arguments.run / "config.yaml"), store.read_inputs(RunFolder(arguments.run)))
    draws = estimands_of(posterior.target, br.load_result(arguments.run).idata.posterior.load())
    every = len(draws["u_boundary"]) // arguments.chains
    places = jax.tree.map(lambda x: x[::every][: arguments.chains], draws)
    data = posterior.target.condition(jax.tree.map(lambda x: x.mean(axis=0), draws))
    print(f"{len(posterior.mesh.points)} nodes, {len(posterior.sampled)} sampled; {arguments.chains} chains")
    frozen(posterior, data, places)
    two_stages(posterior, data, places, arguments.proposals)


def frozen(posterior: Posterior, data: Any, places: dict[str, jax.Array]) -> None:
    """Time a gradient in the displacements with known R and S, beside one with solve and adjoint."""
    chains = len(places["u_boundary"])
    every = jax.vmap(lambda place: complete(posterior.data.blocks, place))(places)
    parameters = [{name: np.asarray(every[name][i]) for name in ("lam", "mu")} for i in range(chains)]
    began = time.perf_counter()
    matrix_pairs = [matrices(posterior, **each) for each in parameters]
    seconds = time.perf_counter() - began
    responses, forms = (jnp.asarray(np.stack(each)) for each in zip(*matrix_pairs, strict=True))
    temperature = [data.blocks[name].reference() for name in ("t_similarity", "t_elastic")]
    images = data.terms["images"]
    free, slots = np.asarray(data.body.system.free), np.asarray(posterior.sampled)

    def full_density(data: Any, place: dict[str, jax.Array], u: jax.Array) -> jax.Array:
        return posterior.target.evaluate_estimands(data, place | {"u_boundary": u}).logdensity

    def frozen_density(data: Any, response: jax.Array, form: jax.Array, u: jax.Array) -> jax.Array:
        nodes = jnp.zeros((len(posterior.mesh.points), 3)).at[slots].set(u)
        nodes = nodes.at[free].set((response @ u.ravel()).reshape(-1, 3))
        similarity = images.quadrature.weights @ images.residuals(nodes) ** 2
        return -similarity / temperature[0] - u.ravel() @ form @ u.ravel() / (2 * temperature[1])

    u = places["u_boundary"]
    by_solve = jax.jit(jax.vmap(jax.grad(full_density, argnums=2), (None, 0, 0)))(data, places, u)
    by_matrix = jax.jit(jax.vmap(jax.grad(frozen_density, argnums=3), (None, 0, 0, 0)))(data, responses, forms, u)
    off = float(jnp.linalg.norm(by_solve - by_matrix) / jnp.linalg.norm(by_solve))
    print(f"\nFrozen; slopes differ by {off:.1e}, that of the rigid prior included")
    timed("a gradient with solve and adjoint", jax.grad(full_density, argnums=2), (data,), places, u)
    timed("a gradient with R and S given", jax.grad(frozen_density, argnums=3), (data,), responses, forms, u)
    print(f"making R and S of all chains: {1e3 * seconds:.0f} ms")


def matrices(posterior: Posterior, lam: np.ndarray, mu: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute R = −K_II⁻¹ K_IB and S = K_BB + K_BI R."""
    matrix = stiffness(posterior.mesh, lam, mu)
    free, sampled = (unknowns_of(np.asarray(x)) for x in (posterior.data.body.system.free, posterior.sampled))
    factor = scipy.linalg.cho_factor(matrix[free][:, free].toarray(), check_finite=False)
    response = -scipy.linalg.cho_solve(factor, matrix[free][:, sampled].toarray(), check_finite=False)
    return response, matrix[sampled][:, sampled].toarray() + matrix[sampled][:, free] @ response


def two_stages(posterior: Posterior, data: Any, places: dict[str, jax.Array], proposals: int) -> None:
    """Print the times of both stages, and the shares of proposals in the support that pass and that are accepted."""
    chains = len(places["u_boundary"])
    evaluate = jax.vmap(posterior.target.evaluate_estimands, in_axes=(None, 0, 0))
    states = jax.jit(jax.vmap(posterior.target.evaluate_estimands, in_axes=(None, 0)))(data, places)
    full_stage = jax.jit(evaluate).lower(data, places, states.u).compile()
    with mock.patch.object(equilibrium, "MAX_ITERATIONS", 1):
        jax.clear_caches()
        first_stage = jax.jit(evaluate).lower(data, places, states.u).compile()
    jax.clear_caches()

    @jax.jit
    def proposed(key: jax.Array) -> Any:
        keys = jax.random.split(key, chains)
        moves = jax.vmap(lambda key, place: _normal_step(key, place, STEPS))(keys, places)
        candidates = jax.tree.map(jnp.add, places, moves)
        return candidates, jax.vmap(posterior.target.supports, in_axes=(None, 0))(data, candidates)

    images, values = data.terms["images"], posterior.reference()
    times: dict[str, list[float]] = {"first": [], "full": []}
    gains, off, iterations = [], [], []
    for key in jax.random.split(jax.random.key(0), proposals):
        proposal, inside = jax.block_until_ready(proposed(key))
        rough, exact = (
            _timed(f, times[n], data, proposal, states.u) for f, n in ((first_stage, "first"), (full_stage, "full"))
        )
        gain = np.asarray(exact.logdensity - states.logdensity)[np.asarray(inside)]
        similarity = rough.similarity_energy - exact.similarity_energy
        similarity *= images.independent_share / values["t_similarity"]
        error = similarity + (rough.strain_energy - exact.strain_energy) / values["t_elastic"]
        gains.append(gain)
        off.append(-np.asarray(error)[np.asarray(inside)])
        iterations.append(np.asarray(exact.solver_iterations))
    gain, error = np.concatenate(gains), np.concatenate(off)
    first_ms, full_ms = (1e3 * np.median(times[name]) for name in ("first", "full"))
    print(f"\nTwo stages; {len(gain)} proposals in the support, {np.mean(iterations):.1f} iterations in full")
    accepted, passed = (np.minimum(1, np.exp(x)) for x in (gain, gain + error))
    both = passed * np.minimum(1, np.exp(-error))
    any_passes = 1 - (1 - passed.mean()) ** chains
    print(
        f"first {first_ms:.2f} ms, full {full_ms:.2f} ms; accepted {accepted.mean():.1%}, past the first stage ", end=""
    )
    print(f"{passed.mean():.1%}, any of {chains} chains {any_passes:.1%}, accepted in two {both.mean():.1%}")
    alone, together = (full_ms / (first_ms + p * full_ms) for p in (passed.mean(), any_passes))
    acceptance_ratio = both.mean() / accepted.mean()
    print(
        f"gain at most {together * acceptance_ratio:.2f}, and {alone * acceptance_ratio:.2f} "
        "if no chain waited for another"
    )


def _timed(function: Any, seconds: list[float], *arguments: Any) -> Any:
    began = time.perf_counter()
    output = jax.block_until_ready(function(*arguments))
    seconds.append(time.perf_counter() - began)
    return output


if __name__ == "__main__":
    main()
