"""One density of every chain, its gradient and its parts, by mesh and number of chains, beside NumPy and SciPy.

    make bench ARGS="-k '0.8k'"

"0.8k" and "5k" are brains, the demonstration's pair on a mesh of the paper's size and on a finer one, without skull,
of which the peers know nothing; the others are balls of three shells, images of 1.5 mm. All boundary nodes are sampled.
Chains' λ and μ are scattered about the reference by a factor of 1.35; solves end where those of chains end. Chains run
as those of samplers do, on a processor in groups. Every part is compiled by itself, anew, and its time and memory are
those of all chains together:

- density; gradient, with its density;
- solve: the elastic equilibrium at each chain's own λ, μ and displacements;
- similarity: displacements to quadrature points, the warped image, the sum of squares; slope, the same with its
  derivative by all displacements.

The finer the mesh, the fewer the chains: 100k nodes have 2.4 million quadrature points, so that four chains there have
as many as 64 have at 5k, and 16 at 30k. More would take the memory of the two-core machines that this is for, and
minutes a round.

Peers evaluate one chain after the other on one core, and so one chain is timed, after all of ours of the same mesh. For
the similarity it is `map_coordinates` alone, handed the points. They end at 5k, where a factor takes seconds;
`studies.benchmarks.solves` has more of them.
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
PARTS = "density", "gradient", "solve", "similarity", "slope"
ROUNDS, ROUNDS_OF_LARGE, PASSES = 9, 5, 7
FLOOR_AT = 1, 4, 16

PROBLEMS = [("0.8k", "linear"), *((mesh, "cubic") for mesh in CHAINS)]
SIXTEEN = [pytest.param(problem, 16, id=f"{'-'.join(problem)}-16") for problem in PROBLEMS if problem[0] == "0.8k"]


def _cases(problem: tuple[str, str]) -> Iterator[Any]:
    """Ours of a problem before its peers."""
    mesh, interpolation = problem
    named = "-".join(problem)
    for chains in CHAINS[mesh]:
        for part in PARTS:
            # Images have no part in it.
            if part != "solve" or interpolation == "cubic":
                yield pytest.param(problem, chains, part, None, id=f"{named}-{chains}-{part}")
    if mesh in EDGES_OF_BRAINS:
        for part, names in {"density": list(SOLVERS), "similarity": ["map_coordinates"]}.items():
            for name in names:
                yield pytest.param(problem, 1, part, name, id=f"{named}-1-{part}-{name}")


class Problem(NamedTuple):
    """A posterior, the names of its mesh and interpolation, and its data as chains have them."""

    mesh: str
    interpolation: str
    posterior: Posterior
    data: Data

    @property
    def told(self) -> dict[str, Any]:
        """What the file says of it."""
        return {
            "mesh": self.mesh,
            "interpolation": self.interpolation,
            "nodes": len(self.posterior.mesh.points),
            "quadrature_points": len(self.posterior.images.quadrature.weights),
        }

    @property
    def rounds(self) -> int:
        """Of a benchmark."""
        return ROUNDS if self.mesh == "0.8k" else ROUNDS_OF_LARGE


class Places(NamedTuple):
    """Where chains are: the positions, λ and μ by cell, displacements of prescribed nodes, of all; their iterations."""

    positions: dict[str, jax.Array]
    lam: jax.Array
    mu: jax.Array
    given: jax.Array
    u: jax.Array
    iterations: jax.Array


@pytest.fixture(scope="module", autouse=True)
def compiled_anew() -> Iterator[None]:
    """Nothing is read from the programs that earlier runs have left."""
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


# Not fixtures of the module: pytest makes those anew for every case, even if problem and chains are the same.
@lru_cache(maxsize=1)
def _problem(mesh: str, interpolation: str) -> Problem:
    _forget()
    posterior = _brain(mesh, interpolation) if mesh in EDGES_OF_BRAINS else _ball(BALLS[mesh], interpolation)
    values = posterior.constrain(posterior.initial(jax.random.key(0)))
    return Problem(mesh, interpolation, posterior, posterior.target.condition(posterior.estimands(values)))


def _forget() -> None:
    """Make room for the next mesh."""
    _problem.cache_clear()
    _places.cache_clear()
    jax.clear_caches()


@lru_cache(maxsize=1)
def _pair() -> Inputs:
    """The demonstration's, made on a mesh of the paper's size."""
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
        given = data.body.prescribed(values["u_boundary"])
        found = equilibrium(data.body.system, lam, mu, given)
        return lam, mu, given, found.u, found.iterations

    return Places(positions, *jax.jit(jax.vmap(settled, in_axes=(None, 0)))(problem.data, positions))


@pytest.mark.parametrize(
    ("problem", "places", "part", "peer"),
    [case for problem in PROBLEMS for case in _cases(problem)],
    indirect=["problem", "places"],
)
def bench_evaluation(problem: Problem, places: Places, part: str, peer: str | None, timed: Callable[..., None]) -> None:
    chains = len(places.u)
    told = {"part": part, "chains": chains, **problem.told}
    if peer is not None:
        function, arguments = at_one_place(problem, places, peer)
        timed(function, *arguments, rounds=problem.rounds, peer=peer, **told)
        return
    function, rest = program(problem, places, part)
    began = perf_counter()
    compiled = function.lower(problem.data, *rest).compile()
    told |= {"compiling": perf_counter() - began, **memory(compiled)}
    if part == "density":
        told["iterations"] = int(places.iterations.max())
    if (problem.mesh, problem.interpolation, part) == ("0.8k", "cubic", "density") and chains in FLOOR_AT:
        least = floor.density_parts(problem.data, chains, told["iterations"])
        told["floor"] = sum(work.seconds(machine()) for work in least)
    timed(compiled, problem.data, *rest, rounds=problem.rounds, **told)


def program(problem: Problem, places: Places, part: str) -> tuple[Any, tuple[Any, ...]]:
    """A part of the density of all chains, jitted, as a function of the data and of what is each chain's, and that."""

    def solve(data: Data, lam: jax.Array, mu: jax.Array, given: jax.Array) -> jax.Array:
        return equilibrium(data.body.system, lam, mu, given).u

    def similarity(data: Data, u: jax.Array) -> jax.Array:
        images = data.terms["images"]
        return images.quadrature.weights @ images.residuals(u) ** 2

    density = partial(logdensity, problem.posterior.target)
    one, each = {
        "density": (density, (places.positions,)),
        "gradient": (jax.value_and_grad(density, argnums=1), (places.positions,)),
        "solve": (solve, (places.lam, places.mu, places.given)),
        "similarity": (similarity, (places.u,)),
        "slope": (jax.value_and_grad(similarity, argnums=1), (places.u,)),
    }[part]
    return jax.jit(lambda data, *each: side_by_side(partial(one, data), None)(*each)), each


def memory(compiled: Any) -> dict[str, int]:
    """Bytes that a program holds while it runs, by what they are for."""
    used = compiled.memory_analysis()
    kinds = {"temporaries": "temp", "arguments": "argument", "outputs": "output"}
    return {f"{name}_bytes": getattr(used, f"{kind}_size_in_bytes") for name, kind in kinds.items()}


@lru_cache
def machine() -> floor.Machine:
    """Measured once."""
    return floor.measured()


def at_one_place(problem: Problem, places: Places, peer: str) -> tuple[Callable[..., Any], list[np.ndarray]]:
    """A peer, and what it is handed for the first chain; there it finds what we do."""
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
    """What issue 4 asks of 16 chains at the paper's size: a peer's density in ours, and densities in a gradient.

    A machine that others use has slow spells, in which what runs on both of its cores waits for the slower one.
    Everything is timed one after the other seven times, medians of nine; the ratios are of the least of these, and
    those of single passes stand beside them.
    """
    parts = [program(problem, places, part) for part in ("density", "gradient")]
    ours = [(function, (problem.data, *each)) for function, each in parts]
    peers = [at_one_place(problem, places, name) for name in SOLVERS]
    passes = [[_median(function, *given) for function, given in (*ours, *peers)] for _ in range(PASSES)]
    of_each = [ratios(len(places.u), *seconds) for seconds in passes]
    gain, densities = ratios(len(places.u), *np.min(passes, axis=0))
    told = {"gain": gain, "densities": densities, "passes": of_each, "chains": len(places.u)}
    timed(ours[0][0], *ours[0][1], rounds=problem.rounds, **told, **problem.told)


def ratios(chains: int, density: float, gradient: float, *peers: float) -> tuple[float, float]:
    """The best peer's density over ours of one chain, our gradient over our density."""
    return float(chains * min(peers) / density), float(gradient / density)
