"""Time one density of every chain, its gradient and its operations, by mesh and chains, beside NumPy and SciPy.

    make bench ARGS="-k '0.8k'"

"0.8k" and "5k" are brains: the demonstration's pair on a mesh of the paper's size and on a finer one, without a skull,
which the peers do not have. The other meshes are balls of three shells, with images of 1.5 mm. All boundary nodes are
sampled. λ and μ of the chains are scattered about the reference by a factor of 1.35, and solves have the tolerance of
chains. Chains run side by side in groups, as those of samplers do. Every operation is compiled separately and anew. Its
time and memory are those of all chains together:

- density; gradient, with its density;
- solve: the elastic equilibrium at λ, μ and the displacements of each chain;
- similarity: displacements to quadrature points, the warped image, the sum of squares; slope: the same with its
  derivative by all displacements.

Finer meshes have fewer chains: 100k nodes have 2.4 million quadrature points, so that four chains there have as many
points as 16 chains at 30k, and 64 chains at 5k. More chains would exceed the memory of a machine with two cores, and
take minutes for each round.

Peers evaluate one chain after the other on one core. Therefore one chain is timed, after all of bayesreg's cases on the
same mesh. The peer of the similarity is `map_coordinates` alone, with the points as its input. Peers end at 5k, where a
factorisation takes seconds; `studies.benchmarks.solves` has more of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

import bayesreg as br
from bayesreg.fem.equilibrium import equilibrium
from bayesreg.inference.chains.devices import side_by_side
from bayesreg.inference.target import estimands_of, logdensity
from bayesreg.io.datasets import mni152
from bayesreg.io.domain import without_ridges
from bayesreg.io.meshing import MeshOptions, build_mesh
from bayesreg.io.records import Inputs
from bayesreg.mesh import TetMesh
from bayesreg.model.build import build_posterior
from bayesreg.model.coordinates import complete
from bayesreg.model.posterior import Posterior
from bayesreg.model.program import Problem as Data
from bayesreg.workflow.preparation import prepare
from studies.benchmarks import floor
from studies.benchmarks.bench_sampling import _median
from studies.benchmarks.places import scattered
from studies.benchmarks.solves import mesh_of
from studies.benchmarks.stored import SOLVERS, _image, log_density
from tests.phantoms import smooth_image

DEMONSTRATION = Path(__file__).parents[2] / "configs" / "quickstart.yaml"
EDGES_OF_BRAINS = {"0.8k": 15.5, "5k": 7.3}
BALLS = {"30k": 30_000, "100k": 100_000}
CHAINS = {"0.8k": (1, 4, 16, 64), "5k": (1, 4, 16, 64), "30k": (1, 4, 16), "100k": (1, 4)}
OPERATIONS = "density", "gradient", "solve", "similarity", "slope"
ROUNDS, ROUNDS_OF_LARGE, PASSES = 9, 5, 7
CHAINS_WITH_FLOOR = 1, 4, 16

PROBLEMS = [("0.8k", "linear"), *((mesh, "cubic") for mesh in CHAINS)]
SIXTEEN = [pytest.param(problem, 16, id=f"{'-'.join(problem)}-16") for problem in PROBLEMS if problem[0] == "0.8k"]


def _cases(problem: tuple[str, str]) -> Iterator[Any]:
    """List the cases of bayesreg for a problem, then those of its peers."""
    mesh, interpolation = problem
    identifier = "-".join(problem)
    for chains in CHAINS[mesh]:
        for operation in OPERATIONS:
            # The solve does not depend on the images.
            if operation != "solve" or interpolation == "cubic":
                yield pytest.param(problem, chains, operation, None, id=f"{identifier}-{chains}-{operation}")
    if mesh in EDGES_OF_BRAINS:
        for operation, names in {"density": list(SOLVERS), "similarity": ["map_coordinates"]}.items():
            for name in names:
                yield pytest.param(problem, 1, operation, name, id=f"{identifier}-1-{operation}-{name}")


class Problem(NamedTuple):
    """A posterior, the names of its mesh and interpolation, and its data conditioned for chains."""

    mesh: str
    interpolation: str
    posterior: Posterior
    data: Data

    @property
    def facts(self) -> dict[str, Any]:
        """The description of the problem in the JSON file."""
        return {
            "mesh": self.mesh,
            "interpolation": self.interpolation,
            "nodes": len(self.posterior.mesh.points),
            "quadrature_points": len(self.posterior.images.quadrature.weights),
        }

    @property
    def rounds(self) -> int:
        """The number of rounds of a benchmark."""
        return ROUNDS if self.mesh == "0.8k" else ROUNDS_OF_LARGE


class Places(NamedTuple):
    """The positions of chains: λ and μ by cell, displacements of prescribed and of all nodes, solver iterations."""

    positions: dict[str, jax.Array]
    lam: jax.Array
    mu: jax.Array
    prescribed: jax.Array
    u: jax.Array
    iterations: jax.Array


@pytest.fixture(scope="module", autouse=True)
def compiled_anew() -> Iterator[None]:
    """Disable the cache of compiled programs."""
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    yield
    _forget()
    jax.config.update("jax_enable_compilation_cache", True)
    compilation_cache.reset_cache()


@pytest.fixture
def problem(request: pytest.FixtureRequest) -> Problem:
    return _problem(*request.param)


@pytest.fixture
def places(request: pytest.FixtureRequest, problem: Problem) -> Places:
    return _places(problem.mesh, problem.interpolation, request.param)


# Not fixtures of the module: pytest makes such fixtures anew for every case, even with equal parameters.
@lru_cache(maxsize=1)
def _problem(mesh: str, interpolation: str) -> Problem:
    _forget()
    posterior = _brain(mesh, interpolation) if mesh in EDGES_OF_BRAINS else _ball(BALLS[mesh], interpolation)
    values = posterior.constrain(posterior.initial(jax.random.key(0)))
    return Problem(mesh, interpolation, posterior, posterior.target.condition(posterior.estimands(values)))


def _forget() -> None:
    """Free the memory for the next mesh."""
    _problem.cache_clear()
    _places.cache_clear()
    jax.clear_caches()


@lru_cache(maxsize=1)
def _pair() -> Inputs:
    """The pair of the demonstration, made on a mesh of the paper's size."""
    return prepare(br.load_config(DEMONSTRATION, [f"mesh.edge_length={EDGES_OF_BRAINS['0.8k']}"])).inputs


def _brain(mesh: str, interpolation: str) -> Posterior:
    pair = _pair()
    images = br.ImagePair(pair.fixed, pair.moving, interpolation=interpolation)
    return build_posterior(pair.mesh if mesh == "0.8k" else _finer(mesh), [images])


def _finer(mesh: str) -> TetMesh:
    head = mni152()
    assert head.intracranial is not None
    return build_mesh(head.tissue, without_ridges(head.intracranial), MeshOptions(EDGES_OF_BRAINS[mesh]))


def _ball(nodes: int, interpolation: str) -> Posterior:
    mesh = mesh_of(nodes)
    fixed, moving = (smooth_image(mesh.points, (120,) * 3, seed=seed, blur=6.0) for seed in (0, 1))
    return build_posterior(mesh, [br.ImagePair(fixed, moving, interpolation=interpolation)])


@lru_cache(maxsize=1)
def _places(mesh: str, interpolation: str, chains: int) -> Places:
    problem = _problem(mesh, interpolation)
    posterior = problem.posterior
    positions = scattered(posterior, chains)

    def settled(data: Data, position: dict[str, jax.Array]) -> Any:
        values = complete(data.blocks, estimands_of(posterior.target, data, position))
        lam, mu = data.body.lame_by_cell(values)
        prescribed = data.body.prescribed(values["u_boundary"])
        state = equilibrium(data.body.system, lam, mu, prescribed)
        return lam, mu, prescribed, state.u, state.iterations

    return Places(positions, *jax.jit(jax.vmap(settled, in_axes=(None, 0)))(problem.data, positions))


@pytest.mark.parametrize(
    ("problem", "places", "operation", "peer"),
    [case for problem in PROBLEMS for case in _cases(problem)],
    indirect=["problem", "places"],
)
def bench_evaluation(
    problem: Problem, places: Places, operation: str, peer: str | None, timed: Callable[..., None]
) -> None:
    chains = len(places.u)
    facts = {"part": operation, "chains": chains, **problem.facts}
    if peer is not None:
        function, arguments = peer_at_first_chain(problem, places, peer)
        timed(function, *arguments, rounds=problem.rounds, peer=peer, **facts)
        return
    function, rest = program(problem, places, operation)
    began = perf_counter()
    compiled = function.lower(problem.data, *rest).compile()
    facts |= {"compiling": perf_counter() - began, **memory(compiled)}
    if operation == "density":
        facts["iterations"] = int(places.iterations.max())
    if (problem.mesh, problem.interpolation, operation) == ("0.8k", "cubic", "density") and chains in CHAINS_WITH_FLOOR:
        least = floor.density_work(problem.data, chains, facts["iterations"])
        facts["floor"] = sum(work.seconds(machine()) for work in least)
    timed(compiled, problem.data, *rest, rounds=problem.rounds, **facts)


def program(problem: Problem, places: Places, operation: str) -> tuple[Any, tuple[Any, ...]]:
    """Return a jitted operation on all chains as a function of the data and of arguments by chain, and the latter."""

    def solve(data: Data, lam: jax.Array, mu: jax.Array, prescribed: jax.Array) -> jax.Array:
        return equilibrium(data.body.system, lam, mu, prescribed).u

    def similarity(data: Data, u: jax.Array) -> jax.Array:
        images = data.terms["images"]
        return images.quadrature.weights @ images.residuals(u) ** 2

    density = partial(logdensity, problem.posterior.target)
    function, arguments = {
        "density": (density, (places.positions,)),
        "gradient": (jax.value_and_grad(density, argnums=1), (places.positions,)),
        "solve": (solve, (places.lam, places.mu, places.prescribed)),
        "similarity": (similarity, (places.u,)),
        "slope": (jax.value_and_grad(similarity, argnums=1), (places.u,)),
    }[operation]
    return jax.jit(lambda data, *arguments: side_by_side(partial(function, data), None)(*arguments)), arguments


def memory(compiled: Any) -> dict[str, int]:
    """Bytes that a program holds while it runs, by their purpose."""
    used = compiled.memory_analysis()
    kinds = {"temporaries": "temp", "arguments": "argument", "outputs": "output"}
    return {f"{name}_bytes": getattr(used, f"{kind}_size_in_bytes") for name, kind in kinds.items()}


@lru_cache
def machine() -> floor.Machine:
    """The speed of this machine, measured once."""
    return floor.measured()


def peer_at_first_chain(problem: Problem, places: Places, peer: str) -> tuple[Callable[..., Any], list[np.ndarray]]:
    """Return a peer and its arguments for the first chain, after a check that its result agrees."""
    posterior, order = problem.posterior, {"linear": 1, "cubic": 3}[problem.interpolation]
    pair = posterior.observations["images"]
    values = posterior.constrain(jax.tree.map(lambda x: x[0], places.positions))
    if peer in SOLVERS:
        arguments = [np.asarray(values[name]) for name in ("u_boundary", "lam", "mu")]
        density = log_density(posterior.mesh, pair.fixed, pair.moving, order, SOLVERS[peer])
        assert np.isclose(density(*arguments), float(posterior.logdensity_constrained(values)), rtol=1e-9)
        return density, arguments
    images = posterior.images
    points = images.places(posterior.evaluate(values).u)
    image, arguments = _image(pair.moving, order), [np.asarray(points)]
    assert np.allclose(image(*arguments), images.moving(points), rtol=1e-9)
    return image, arguments


@pytest.mark.parametrize(("problem", "places"), SIXTEEN, indirect=True)
def bench_ratios(problem: Problem, places: Places, timed: Callable[..., None]) -> None:
    """Measure the ratios that issue 4 bounds, with 16 chains at the paper's size.

    They are the density of the best peer over bayesreg's, and bayesreg's gradient over its density. On a shared machine
    a program on both cores sometimes waits for the slower one. Therefore all programs are timed in turn, in seven
    passes of medians of nine. The ratios are of the least times; the file also has the ratios of single passes.
    """
    programs = [program(problem, places, operation) for operation in ("density", "gradient")]
    calls = [(function, (problem.data, *each)) for function, each in programs]
    peers = [peer_at_first_chain(problem, places, name) for name in SOLVERS]
    passes = [[_median(function, *arguments) for function, arguments in (*calls, *peers)] for _ in range(PASSES)]
    ratios_of_passes = [ratios(len(places.u), *seconds) for seconds in passes]
    gain, densities = ratios(len(places.u), *np.min(passes, axis=0))
    facts = {"gain": gain, "densities": densities, "passes": ratios_of_passes, "chains": len(places.u)}
    timed(calls[0][0], *calls[0][1], rounds=problem.rounds, **facts, **problem.facts)


def ratios(chains: int, density: float, gradient: float, *peers: float) -> tuple[float, float]:
    """Return the best peer's density over bayesreg's, for one chain, and bayesreg's gradient over its density."""
    return float(chains * min(peers) / density), float(gradient / density)
