"""The default sampler beside those of other libraries: one log density, one budget of time.

    python -m studies.benchmarks.other_samplers [RUN] [--minutes 5] [--chains 4] [--samplers numpyro-nuts cuqi-pcn …]

RUN is a run's folder; without it a phantom is registered, a ball pressed in from the side, with a wall above it. All
chains start at the same places, overdispersed about the mode. The search for it is on nobody's account, its last
seconds on that of `hmc`. The others sample `bayesreg.inference.target.logdensity`, its elastic solves as for chains of
`hmc`, in unconstrained coordinates and in those that `hmc` has whitened by the end of its warm-up, which they are
given.

- Warm-up counts, and takes the others a third of the budget. Compilation does not, tracing included; it is told.
- NumPyro's chains are vectorised. It has its diagonal mass and a warm-up of 1,000 transitions, cut off when the third
  is over, with the mass and the averaged step size that it has by then.
- Chains of CUQIpy and tinyDA run in threads; of each as many draws are taken as the shortest has, and a transition that
  is not over in time is dropped. CUQIpy's NUTS is tuned after each transition, other scales every 25. pCN is about
  N(0, I). Steps are at first 0.008, the paper's, in unconstrained coordinates, and 2.4 / √d in whitened ones.
- Trees of both No-U-Turn samplers have up to 2¹⁰ − 1 gradients, NumPyro's default.
- tinyDA's adaptive Metropolis learns a covariance once it has d draws, and draws by Cholesky's factor here: its own way
  is a singular value decomposition for each draw. Its MALA is handed the gradient with the density: its own way are
  finite differences.
- The skull is a soft wall.

Evaluations are those after the warm-up. Rates in parentheses are worth nothing: chains whose R̂ is above 1.1 have yet
to meet, and the effective sample size of a short one is about that of so many chains.
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
from bayesreg.inference.chains.checkpoint import Checkpoint
from bayesreg.inference.chains.initialise import Start
from bayesreg.inference.chains.run import first_checkpoint, sample
from bayesreg.inference.draws.blocks import Block
from bayesreg.inference.draws.diagnostics import worst
from bayesreg.inference.gaussian.laplace import Gaussian
from bayesreg.inference.gaussian.whitened import whiten
from bayesreg.inference.layout import unravel
from bayesreg.inference.target import estimands_of
from bayesreg.io import store
from bayesreg.io.run_folder import RunFolder
from bayesreg.workflow.assembly import posterior_of, start_of
from tests.phantoms import ball_mesh, flat_skull, smooth_image

BLOCK, TREE_DEPTH, WARM_UP, TUNED_EVERY, ENDLESS = 20, 10, 1_000, 25, 10**9
INSTALL = {"numpyro": "numpyro", "cuqi": "--no-deps cuqipy", "tinyDA": "--no-deps tinyDA ray, and what it then misses"}
COLUMNS = (
    "sampler, coordinates", "draws per chain", "least ESS bulk / tail", "greatest R̂", "gradients", "densities",
    "seconds", "compiling", "ESS/s", "of that of hmc",
)  # fmt: skip


class Problem(NamedTuple):
    """A log density of flat coordinates, whitened if there is a Gaussian, where chains start, and the first step."""

    posterior: Any
    data: Any
    gaussian: Gaussian | None
    starts: np.ndarray
    step: float


class Drawn(NamedTuple):
    """Estimands after the warm-up, and how often the density was evaluated with its gradient, and without."""

    blocks: list[Block]
    gradients: int
    densities: int


class Moment(NamedTuple):
    """Seconds of a clock that stands still while JAX traces and compiles, and of one that goes only then."""

    clock: float
    compiling: float


class OutOfTimeError(Exception):
    """Ends what has no end of its own."""


def main() -> None:
    """Print a row for each sampler."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--minutes", type=float, default=5.0, help="for each sampler")
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samplers", nargs="*", default=list(PEERS), choices=list(PEERS), metavar="SAMPLER")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.monitoring.register_event_duration_secs_listener(_note_compilation)
    posterior, start = phantom() if given.run is None else _of_run(given.run)
    places, first, began = prepared(posterior, start, given.chains, given.seed)
    print(f"{len(posterior.mesh.points)} nodes, {len(posterior.sampled)} sampled, {places.shape[1]} unknowns\n")
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    seconds, found = 60 * given.minutes, problems(posterior, first, places)
    ours = told("hmc", default_sampler(posterior, first, began.clock + seconds, given.seed), began)
    for name in given.samplers:
        library = name.split("-")[0]
        try:
            importlib.import_module(library)
        except ImportError as error:
            print(f"| {name} | left out, {error}: pip install {INSTALL[library]} |", flush=True)
            continue
        for coordinates, problem in found.items():
            began = now()
            told(f"{name}, {coordinates}", PEERS[name](problem, began.clock + seconds, given.seed), began, ours)


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
    """Flat positions about the mode, where `hmc` warms up to its checkpoint, and when its search last spoke."""
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
    """Draws of `hmc`, one block at least."""
    blocks: list[Block] = []
    with contextlib.suppress(OutOfTimeError):
        sample(
            posterior, "hmc", len(first.tally.steps), ENDLESS, seed, block=BLOCK, progress=False,
            resume=(first, blocks), on_block=lambda *_: _require_time(until),
        )  # fmt: skip
    return Drawn(blocks, sum(int(block["gradients"].sum()) for block in blocks), 0)


def problems(posterior: Any, first: Checkpoint, places: np.ndarray) -> dict[str, Problem]:
    """The density in unconstrained coordinates, and in those of `hmc` after its warm-up."""
    gaussian, middle = first.setup.gaussian, unravel(posterior.target)(first.setup.middle)
    data = posterior.target.condition(estimands_of(posterior.target, posterior.data, middle))
    xi = np.asarray(jax.vmap(partial(whiten, gaussian))(jnp.asarray(places)))
    return {
        "unconstrained": Problem(posterior, data, None, places, 0.008),
        "whitened": Problem(posterior, data, gaussian, xi, 2.4 / np.sqrt(xi.shape[1])),
    }


def position(posterior: Any, gaussian: Gaussian | None, x: jax.Array) -> dict[str, jax.Array]:
    """The position at flat coordinates."""
    return unravel(posterior.target)(x if gaussian is None else gaussian.place(x))


def logdensity(posterior: Any, data: Any, gaussian: Gaussian | None, x: jax.Array) -> jax.Array:
    """Of flat coordinates; whitening is linear, and leaves out a constant."""
    return targets.logdensity(posterior.target, data, position(posterior, gaussian, x))


value = jax.jit(logdensity, static_argnums=0)
value_and_slope = jax.jit(jax.value_and_grad(logdensity, argnums=3), static_argnums=0)


def estimands(problem: Problem, draws: np.ndarray) -> list[Block]:
    """Flat coordinates (chain, draw, …) as a block of draws, if there are any."""
    posterior, data, gaussian = problem[:3]
    every = jax.jit(
        jax.vmap(jax.vmap(lambda x: estimands_of(posterior.target, data, position(posterior, gaussian, x))))
    )
    return [jax.tree.map(np.asarray, every(draws))] if draws.size else []


def numpyro_nuts(problem: Problem, until: float, seed: int) -> Drawn:
    """NumPyro's No-U-Turn sampler by its kernel, so that the clock can end it after each transition of all chains."""
    from numpyro.infer import NUTS

    end_of_warm_up = until - 2 / 3 * (until - now().clock)
    kernel = NUTS(potential_fn=lambda x: -logdensity(*problem[:3], x), max_tree_depth=TREE_DEPTH)
    keys = jax.random.split(jax.random.key(seed), len(problem.starts))
    first = kernel.init(keys, WARM_UP, init_params=jnp.asarray(problem.starts))
    step = jax.jit(lambda state: kernel.sample(state, (), {}))
    warm = _frozen(deque(_transitions(step, first, WARM_UP, end_of_warm_up), maxlen=1).pop())
    kept = [(np.asarray(state.z), int(state.num_steps.sum())) for state in _transitions(step, warm, ENDLESS, until)]
    return Drawn(estimands(problem, np.stack([z for z, _ in kept], axis=1)), sum(steps for _, steps in kept), 0)


def _transitions(step: Callable[[Any], Any], state: Any, most: int, until: float) -> Iterator[Any]:
    """States by and by, one at least."""
    for _ in range(most):
        state = jax.block_until_ready(step(state))
        yield state
        if now().clock > until:
            return


def _frozen(state: Any) -> Any:
    """A state whose warm-up is over, with the averaged step size where it was cut off."""
    adapted = state.adapt_state
    _, log_step_size, _, updates, _ = adapted.ss_state
    averaged = jnp.where((state.i < WARM_UP) & (updates > 0), jnp.exp(log_step_size), adapted.step_size)
    return state._replace(i=jnp.full_like(state.i, WARM_UP), adapt_state=adapted._replace(step_size=averaged))


class Density:
    """A log density for libraries that ask for one value at a time: it counts, and ends them."""

    def __init__(self, problem: Problem) -> None:
        self.arguments, self.until, self.gradients, self.densities = problem[:3], np.inf, 0, 0
        self._last: tuple[Any, ...] = (None,)

    def value(self, x: np.ndarray) -> float:
        """Log density."""
        _require_time(self.until)
        self.densities += 1
        return float(value(*self.arguments, np.asarray(x, float)))

    def value_and_slope(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """The same with its gradient; at the last place again it costs nothing."""
        x = np.array(x, float)
        if not np.array_equal(self._last[0], x):
            _require_time(self.until)
            self.gradients += 1
            height, slope = value_and_slope(*self.arguments, x)
            self._last = (x, float(height), np.asarray(slope))
        return self._last[1:]


class Chain(NamedTuple):
    """What warms a chain up and what samples, both without end, and what gives all draws so far, (draw, …)."""

    warm_up: Callable[[], Any]
    sample: Callable[[], Any]
    draws: Callable[[], np.ndarray]


Begin = Callable[[Density, np.ndarray, float], Chain]


def side_by_side(begin: Begin, problem: Problem, until: float, seed: int) -> Drawn:
    """Chains in threads."""
    for program in (value, value_and_slope):
        jax.block_until_ready(program(*problem[:3], problem.starts[0]))
    # The libraries draw from the global generator, and their progress bars are not wanted.
    np.random.seed(seed)
    with contextlib.redirect_stderr(io.StringIO()), ThreadPoolExecutor(len(problem.starts)) as threads:
        found = list(threads.map(lambda start: _walked(begin, problem, start, until), problem.starts))
    shortest = min(len(draws) for draws, _ in found)
    gradients, densities = zip(*((density.gradients, density.densities) for _, density in found), strict=True)
    return Drawn(estimands(problem, np.stack([x[:shortest] for x, _ in found])), sum(gradients), sum(densities))


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
        # Its slice variable is an array of one number, whose comparisons NumPy 2.4 does not turn into integers.
        def _BuildTree(self, point: Any, r: Any, slope: Any, energy: Any, log_u: Any, *rest: Any) -> Any:  # noqa: N802
            return super()._BuildTree(point, r, slope, energy, float(np.squeeze(log_u)), *rest)

    height, slope = (lambda x: density.value_and_slope(x)[0]), (lambda x: density.value_and_slope(x)[1])
    target = UserDefinedDistribution(len(start), height, slope, name="x")
    # It counts depths from zero.
    return _of_cuqi(ScalarSlice(target, initial_point=start, max_depth=TREE_DEPTH - 1), 1)


def cuqi_pcn(density: Density, start: np.ndarray, step: float) -> Chain:
    from cuqi.distribution import Gaussian, Posterior
    from cuqi.likelihood import UserDefinedLikelihood
    from cuqi.sampler import PCN

    left = UserDefinedLikelihood(len(start), lambda x: density.value(x) + 0.5 * float(np.sum(np.square(x))), name="y")
    target = Posterior(left, Gaussian(np.zeros(len(start)), 1.0, name="x"))
    return _of_cuqi(PCN(target, scale=min(step, 1.0), initial_point=start), TUNED_EVERY)


def _of_cuqi(sampler: Any, every: int) -> Chain:
    return Chain(
        lambda: sampler.warmup(ENDLESS, tune_freq=every / ENDLESS),
        lambda: sampler.sample(ENDLESS),
        lambda: sampler.get_samples().samples.T.reshape(-1, sampler.dim),
    )


def tinyda_mala(density: Density, start: np.ndarray, step: float) -> Chain:
    from tinyDA import MALA

    class GivenGradient(MALA):
        def setup_proposal(self, **_: Any) -> None:
            self.d, self.compute_gradient = len(start), lambda link: link.qoi

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        height, slope = density.value_and_slope(x)
        return np.array([height]), slope

    return _of_tinyda(model, GivenGradient(step, adaptive=True, period=TUNED_EVERY), start)


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
    """With a prior of density one, and a model whose output is the log likelihood."""
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
        # A program is traced while the one that calls it is.
        while _compilations and _compilations[-1][0] >= ended - seconds - 1e-3:
            _compilations.pop()
        _compilations.append((ended - seconds, ended))


def now() -> Moment:
    """What both clocks show."""
    compiling = sum(ended - began for began, ended in _compilations)
    return Moment(time.perf_counter() - compiling, compiling)


def _require_time(until: float) -> None:
    if now().clock > until:
        raise OutOfTimeError


def told(name: str, drawn: Drawn, began: Moment, ours: float | None = None) -> float:
    """Print a row; the least effective sample size per second."""
    seconds, compiling = np.subtract(now(), began)
    found, draws = worst(drawn.blocks), sum(block["u_boundary"].shape[1] for block in drawn.blocks)
    rate = min(found.ess_bulk, found.ess_tail) / seconds
    rates = (f"{each:.2g}" if found.rhat < 1.1 else f"({each:.2g})" for each in (rate, rate / (ours or rate or 1)))
    cells = (
        name, f"{draws:,}", f"{found.ess_bulk:.0f} / {found.ess_tail:.0f}", f"{found.rhat:.3f}",
        f"{drawn.gradients:,}", f"{drawn.densities:,}", f"{seconds:.0f}", f"{compiling:.0f}", *rates,
    )  # fmt: skip
    print(f"| {' | '.join(cells)} |", flush=True)
    return rate


if __name__ == "__main__":
    main()
