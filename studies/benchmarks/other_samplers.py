"""Compare the default sampler with those of other libraries, on one log density and with one budget of time.

    python -m studies.benchmarks.other_samplers [RUN] [--minutes 5] [--chains 4] [--samplers numpyro-nuts cuqi-pcn …]

RUN is a run's folder. Without it the problem is a phantom: a ball that is pressed in from the side, with a wall above
it. All chains start at the same places, overdispersed about the mode. The search for the mode is not counted, except
for its last seconds, which `hmc` pays. The other samplers use `bayesreg.inference.target.logdensity`, with the elastic
solves of `hmc`'s chains. They run in unconstrained coordinates, and in the coordinates that `hmc` has whitened by the
end of its warm-up.

- Warm-up counts; that of the other samplers takes a third of the budget. Compilation and tracing do not count; the
  table shows their time.
- NumPyro's chains are vectorised. It has a diagonal mass matrix and a warm-up of 1,000 transitions. If a third of the
  budget is over earlier, the warm-up ends with the mass matrix and the averaged step size of that time.
- Chains of CUQIpy and tinyDA run in threads. All are cut to the length of the shortest, and a transition that does not
  end in time is dropped. CUQIpy's NUTS is tuned after each transition, the other scales every 25. pCN is about N(0, I).
  The first steps are 0.008, as in the paper, in unconstrained coordinates, and 2.4 / √d in whitened ones.
- The trees of both No-U-Turn samplers have up to 2¹⁰ − 1 gradients, NumPyro's default.
- tinyDA's adaptive Metropolis learns a covariance after d draws. Here it draws by a Cholesky factor, because its own
  method computes a singular value decomposition for each draw. Its MALA gets the gradient with the density, because its
  own method takes finite differences.
- The skull is a soft wall.

The table counts the evaluations after the warm-up. Rates in parentheses are meaningless: chains whose R̂ is above 1.1
have not converged, and their effective sample size is about the number of chains.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import bayesreg as br
from bayesreg.inference import target as targets
from bayesreg.inference.chains.beginning import first_checkpoint
from bayesreg.inference.chains.checkpoint import Checkpoint
from bayesreg.inference.chains.initialise import Start
from bayesreg.inference.chains.run import sample
from bayesreg.inference.draws.blocks import Block
from bayesreg.inference.draws.diagnostics import worst
from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.layout import unravel
from bayesreg.inference.target import estimands_of
from bayesreg.io import store
from bayesreg.io.run_folder import RunFolder
from bayesreg.workflow.assembly import posterior_of, start_of
from tests.phantoms import ball_mesh, flat_skull, smooth_image

BLOCK, TREE_DEPTH, WARM_UP, TUNED_EVERY, ENDLESS = 20, 10, 1_000, 25, 10**9
INSTALL = {"numpyro": "numpyro", "cuqi": "--no-deps cuqipy", "tinyDA": "--no-deps tinyDA ray, and the missing modules"}
COLUMNS = (
    "sampler, coordinates", "draws per chain", "least ESS bulk / tail", "greatest R̂", "gradients", "densities",
    "seconds", "compiling", "ESS/s", "of that of hmc",
)  # fmt: skip


class Problem(NamedTuple):
    """A log density of flat coordinates, whitened if there is a Gaussian; the starts of chains; and the first step."""

    posterior: Any
    data: Any
    gaussian: Gaussian | None
    starts: np.ndarray
    step: float


class Drawn(NamedTuple):
    """Estimands after the warm-up, and the number of evaluations with and without the gradient."""

    blocks: list[Block]
    gradients: int
    densities: int


class Moment(NamedTuple):
    """The seconds outside and inside JAX's tracing and compilation, on two clocks."""

    clock: float
    compiling: float


class OutOfTimeError(Exception):
    """The budget of time is over; it ends a sampler that has no other end."""


def main() -> None:
    """Print a row for each sampler."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--minutes", type=float, default=5.0, help="budget of each sampler")
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samplers", nargs="*", default=list(PEERS), choices=list(PEERS), metavar="SAMPLER")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.monitoring.register_event_duration_secs_listener(_note_compilation)
    posterior, start = phantom() if arguments.run is None else _of_run(arguments.run)
    places, first, began = prepared(posterior, start, arguments.chains, arguments.seed)
    print(f"{len(posterior.mesh.points)} nodes, {len(posterior.sampled)} sampled, {places.shape[1]} unknowns\n")
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    seconds, problems_by_coordinates = 60 * arguments.minutes, problems(posterior, first, places)
    rate_of_hmc = print_row("hmc", default_sampler(posterior, first, began.clock + seconds, arguments.seed), began)
    for name in arguments.samplers:
        library = name.split("-")[0]
        try:
            importlib.import_module(library)
        except ImportError as error:
            print(f"| {name} | not installed, {error}: pip install {INSTALL[library]} |", flush=True)
            continue
        for coordinates, problem in problems_by_coordinates.items():
            began = now()
            print_row(
                f"{name}, {coordinates}",
                PEERS[name](problem, began.clock + seconds, arguments.seed),
                began,
                rate_of_hmc,
            )


def _of_run(folder: Path) -> tuple[br.Posterior, Start]:
    config, inputs = br.load_config(folder / "config.yaml"), store.read_inputs(RunFolder(folder))
    posterior = posterior_of(config, inputs)
    return posterior, start_of(config, inputs, posterior)


def phantom() -> tuple[br.Posterior, Start]:
    """A ball of three tissues, its side pressed in by 4 mm, half a millimetre under a wall."""
    mesh = ball_mesh(radius=70, spacing=16)
    moving = smooth_image(mesh.points, (60, 60, 60), blur=1.0)
    points, side = moving.grid_points(), mesh.points.mean(axis=0) + np.array([70.0, 0.0, 0.0])
    pressed = np.exp(-((points - side) ** 2).sum(axis=-1, keepdims=True) / (2 * 30.0**2)) * np.array([-4.0, 0.0, 0.0])
    noise = 0.003 * np.random.default_rng(0).normal(size=moving.shape)
    fixed = moving.with_voxels(moving.interpolate(points + pressed, "cubic") + noise)
    skull = flat_skull(mesh.points, axis=2, wall=mesh.points[:, 2].max() + 0.5, voxel=2.0)
    images = br.ImagePair(fixed, moving, similarity=br.SquaredDifferences(temperature=0.01), interpolation="cubic")
    return br.build_posterior(mesh, [images], br.ModelConfig(fixed={"mu": {"gm": 1.0}}), skull), Start()


def prepared(posterior: Any, start: Start, chains: int, seed: int) -> tuple[np.ndarray, Checkpoint, Moment]:
    """Return flat positions about the mode, `hmc`'s checkpoint after its warm-up, and the end of its search."""
    about_mode = first_checkpoint(posterior.target, "laplace", chains, seed, start)
    heard = [now()]

    def hear(record: logging.LogRecord) -> bool:
        heard.append(now() if record.getMessage().startswith("mode") else heard[-1])
        return True

    log = logging.getLogger("bayesreg.inference.gaussian.mode_search")
    log.setLevel(logging.INFO)
    log.addFilter(hear)
    first = first_checkpoint(posterior.target, "hmc", chains, seed, start)
    log.removeFilter(hear)
    return np.asarray(jax.vmap(about_mode.setup.gaussian.place)(about_mode.state.position)), first, heard[-1]


def default_sampler(posterior: Any, first: Checkpoint, until: float, seed: int) -> Drawn:
    """Draw with `hmc` until the time is over, one block at least."""
    blocks: list[Block] = []
    with contextlib.suppress(OutOfTimeError):
        sample(
            posterior, "hmc", len(first.tally.steps), ENDLESS, seed, block=BLOCK, progress=False,
            resume=(first, blocks), on_block=lambda *_: _require_time(until),
        )  # fmt: skip
    return Drawn(blocks, sum(int(block["gradients"].sum()) for block in blocks), 0)


def problems(posterior: Any, first: Checkpoint, places: np.ndarray) -> dict[str, Problem]:
    """The problem in unconstrained coordinates, and in those of `hmc` after its warm-up."""
    gaussian, middle = first.setup.gaussian, unravel(posterior.target)(first.setup.middle)
    data = posterior.target.condition(estimands_of(posterior.target, posterior.data, middle))
    xi = np.asarray(jax.vmap(gaussian.whiten)(jnp.asarray(places)))
    return {
        "unconstrained": Problem(posterior, data, None, places, 0.008),
        "whitened": Problem(posterior, data, gaussian, xi, 2.4 / np.sqrt(xi.shape[1])),
    }


def position(posterior: Any, gaussian: Gaussian | None, x: jax.Array) -> dict[str, jax.Array]:
    """The position at flat coordinates."""
    return unravel(posterior.target)(x if gaussian is None else gaussian.place(x))


def logdensity(posterior: Any, data: Any, gaussian: Gaussian | None, x: jax.Array) -> jax.Array:
    """The log density of flat coordinates; whitening is linear, so that only a constant is missing."""
    return targets.logdensity(posterior.target, data, position(posterior, gaussian, x))


value = jax.jit(logdensity, static_argnums=0)
value_and_slope = jax.jit(jax.value_and_grad(logdensity, argnums=3), static_argnums=0)


def estimands(problem: Problem, draws: np.ndarray) -> list[Block]:
    """Convert flat coordinates (chain, draw, …) to a block of draws; without draws the list is empty."""
    posterior, data, gaussian = problem[:3]
    every = jax.jit(
        jax.vmap(jax.vmap(lambda x: estimands_of(posterior.target, data, position(posterior, gaussian, x))))
    )
    return [jax.tree.map(np.asarray, every(draws))] if draws.size else []


def numpyro_nuts(problem: Problem, until: float, seed: int) -> Drawn:
    """Run the kernel of NumPyro's No-U-Turn sampler, so that the clock can end it after each transition."""
    from numpyro.infer import NUTS

    end_of_warm_up = until - 2 / 3 * (until - now().clock)
    kernel = NUTS(potential_fn=lambda x: -logdensity(*problem[:3], x), max_tree_depth=TREE_DEPTH)
    keys = jax.random.split(jax.random.key(seed), len(problem.starts))
    first = kernel.init(keys, WARM_UP, init_params=jnp.asarray(problem.starts))
    step = jax.jit(lambda state: kernel.sample(state, (), {}))
    warm = _frozen(deque(_transitions(step, first, WARM_UP, end_of_warm_up), maxlen=1).pop())
    transitions = [
        (np.asarray(state.z), int(state.num_steps.sum())) for state in _transitions(step, warm, ENDLESS, until)
    ]
    return Drawn(
        estimands(problem, np.stack([z for z, _ in transitions], axis=1)), sum(steps for _, steps in transitions), 0
    )


def _transitions(step: Callable[[Any], Any], state: Any, most: int, until: float) -> Iterator[Any]:
    """Yield at most `most` states until the time is over, one at least."""
    for _ in range(most):
        state = jax.block_until_ready(step(state))
        yield state
        if now().clock > until:
            return


def _frozen(state: Any) -> Any:
    """End the warm-up of a state; if it was cut off, the state gets the averaged step size."""
    adapted = state.adapt_state
    _, log_step_size, _, updates, _ = adapted.ss_state
    averaged = jnp.where((state.i < WARM_UP) & (updates > 0), jnp.exp(log_step_size), adapted.step_size)
    return state._replace(i=jnp.full_like(state.i, WARM_UP), adapt_state=adapted._replace(step_size=averaged))


class Density:
    """A log density that counts its evaluations, and raises OutOfTimeError when the time is over."""

    def __init__(self, problem: Problem) -> None:
        self.arguments, self.until, self.gradients, self.densities = problem[:3], np.inf, 0, 0
        self._last: tuple[Any, ...] = (None,)

    def value(self, x: np.ndarray) -> float:
        """The log density at flat coordinates."""
        _require_time(self.until)
        self.densities += 1
        return float(value(*self.arguments, np.asarray(x, float)))

    def value_and_slope(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """The log density and its gradient; a repeated call at the same place is free."""
        x = np.array(x, float)
        if not np.array_equal(self._last[0], x):
            _require_time(self.until)
            self.gradients += 1
            height, slope = value_and_slope(*self.arguments, x)
            self._last = (x, float(height), np.asarray(slope))
        return self._last[1:]


class Chain(NamedTuple):
    """Functions that warm up and sample a chain without end, and one that returns all draws so far, (draw, …)."""

    warm_up: Callable[[], Any]
    sample: Callable[[], Any]
    draws: Callable[[], np.ndarray]


Begin = Callable[[Density, np.ndarray, float], Chain]


def side_by_side(begin: Begin, problem: Problem, until: float, seed: int) -> Drawn:
    """Run the chains of a problem in threads."""
    for program in (value, value_and_slope):
        jax.block_until_ready(program(*problem[:3], problem.starts[0]))
    # The libraries draw from the global generator, and print progress bars to standard error.
    np.random.seed(seed)
    with contextlib.redirect_stderr(io.StringIO()), ThreadPoolExecutor(len(problem.starts)) as threads:
        walks = list(threads.map(lambda start: _walked(begin, problem, start, until), problem.starts))
    shortest = min(len(draws) for draws, _ in walks)
    gradients, densities = zip(*((density.gradients, density.densities) for _, density in walks), strict=True)
    return Drawn(estimands(problem, np.stack([x[:shortest] for x, _ in walks])), sum(gradients), sum(densities))


def _walked(begin: Begin, problem: Problem, start: np.ndarray, until: float) -> tuple[np.ndarray, Density]:
    density = Density(problem)
    chain = begin(density, start, problem.step)
    density.until = until - 2 / 3 * (until - now().clock)
    with contextlib.suppress(OutOfTimeError):
        chain.warm_up()
    discarded, density.until, density.gradients, density.densities = len(chain.draws()), until, 0, 0
    with contextlib.suppress(OutOfTimeError):
        chain.sample()
    return chain.draws()[discarded:], density


def cuqi_nuts(density: Density, start: np.ndarray, step: float) -> Chain:
    from cuqi.distribution import UserDefinedDistribution
    from cuqi.sampler import NUTS

    class ScalarSlice(NUTS):
        # CUQIpy's slice variable is an array of one number; NumPy 2.4 does not convert its comparisons to integers.
        def _BuildTree(self, point: Any, r: Any, slope: Any, energy: Any, log_u: Any, *rest: Any) -> Any:  # noqa: N802
            return super()._BuildTree(point, r, slope, energy, float(np.squeeze(log_u)), *rest)

    height, slope = (lambda x: density.value_and_slope(x)[0]), (lambda x: density.value_and_slope(x)[1])
    target = UserDefinedDistribution(len(start), height, slope, name="x")
    # CUQIpy counts depths from zero.
    return _of_cuqi(ScalarSlice(target, initial_point=start, max_depth=TREE_DEPTH - 1), 1)


def cuqi_pcn(density: Density, start: np.ndarray, step: float) -> Chain:
    from cuqi.distribution import Gaussian, Posterior
    from cuqi.likelihood import UserDefinedLikelihood
    from cuqi.sampler import PCN

    likelihood = UserDefinedLikelihood(
        len(start), lambda x: density.value(x) + 0.5 * float(np.sum(np.square(x))), name="y"
    )
    target = Posterior(likelihood, Gaussian(np.zeros(len(start)), 1.0, name="x"))
    return _of_cuqi(PCN(target, scale=min(step, 1.0), initial_point=start), TUNED_EVERY)


def _of_cuqi(sampler: Any, every: int) -> Chain:
    return Chain(
        lambda: sampler.warmup(ENDLESS, tune_freq=every / ENDLESS),
        lambda: sampler.sample(ENDLESS),
        lambda: sampler.get_samples().samples.T.reshape(-1, sampler.dim),
    )


def tinyda_mala(density: Density, start: np.ndarray, step: float) -> Chain:
    from tinyDA import MALA

    class SuppliedGradient(MALA):
        def setup_proposal(self, **_: Any) -> None:
            self.d, self.compute_gradient = len(start), lambda link: link.qoi

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        height, slope = density.value_and_slope(x)
        return np.array([height]), slope

    return _of_tinyda(model, SuppliedGradient(step, adaptive=True, period=TUNED_EVERY), start)


def tinyda_am(density: Density, start: np.ndarray, step: float) -> Chain:
    from tinyDA import AdaptiveMetropolis

    class ByCholesky(AdaptiveMetropolis):
        factored: tuple[Any, Any] = (None, None)

        def make_proposal(self, link: Any) -> np.ndarray:
            if self.factored[0] is not self.C:
                self.factored = self.C, np.linalg.cholesky(self.C)
            return link.parameters + self.scaling * self.factored[1] @ np.random.normal(size=self.d)

    proposal = ByCholesky(step**2 * np.eye(len(start)), t0=len(start), period=TUNED_EVERY, adaptive=True)
    return _of_tinyda(lambda x: np.array([density.value(x)]), proposal, start)


def _of_tinyda(model: Callable[[np.ndarray], Any], proposal: Any, start: np.ndarray) -> Chain:
    """Make a chain of tinyDA with a flat prior, and a model whose output is the log likelihood."""
    import tinyDA

    flat = SimpleNamespace(logpdf=lambda x: 0.0, loglike=lambda output: float(output[0]))
    chain = tinyDA.Chain(tinyDA.Posterior(flat, flat, model), proposal, start)
    go_on = partial(chain.sample, ENDLESS, progressbar=False)
    return Chain(go_on, go_on, lambda: np.array([link.parameters for link in chain.chain]))


PEERS: dict[str, Callable[[Problem, float, int], Drawn]] = {
    "numpyro-nuts": numpyro_nuts,
    "cuqi-nuts": partial(side_by_side, cuqi_nuts),
    "cuqi-pcn": partial(side_by_side, cuqi_pcn),
    "tinyDA-mala": partial(side_by_side, tinyda_mala),
    "tinyDA-am": partial(side_by_side, tinyda_am),
}

_compilations: list[tuple[float, float]] = []


def _note_compilation(event: str, seconds: float, **_: Any) -> None:
    ended = time.perf_counter()
    if event.startswith("/jax/core/compile/"):
        # The tracing of a program includes that of the programs it calls.
        while _compilations and _compilations[-1][0] >= ended - seconds - 1e-3:
            _compilations.pop()
        _compilations.append((ended - seconds, ended))


def now() -> Moment:
    """The current time of both clocks."""
    compiling = sum(ended - began for began, ended in _compilations)
    return Moment(time.perf_counter() - compiling, compiling)


def _require_time(until: float) -> None:
    if now().clock > until:
        raise OutOfTimeError


def print_row(name: str, drawn: Drawn, began: Moment, rate_of_hmc: float | None = None) -> float:
    """Print a row, and return the least effective sample size per second."""
    seconds, compiling = np.subtract(now(), began)
    diagnostics, draws = worst(drawn.blocks), sum(block["u_boundary"].shape[1] for block in drawn.blocks)
    rate = min(diagnostics.ess_bulk, diagnostics.ess_tail) / seconds
    rates = (
        f"{each:.2g}" if diagnostics.rhat < 1.1 else f"({each:.2g})"
        for each in (rate, rate / (rate_of_hmc or rate or 1))
    )
    cells = (
        name, f"{draws:,}", f"{diagnostics.ess_bulk:.0f} / {diagnostics.ess_tail:.0f}", f"{diagnostics.rhat:.3f}",
        f"{drawn.gradients:,}", f"{drawn.densities:,}", f"{seconds:.0f}", f"{compiling:.0f}", *rates,
    )  # fmt: skip
    print(f"| {' | '.join(cells)} |", flush=True)
    return rate


if __name__ == "__main__":
    main()
