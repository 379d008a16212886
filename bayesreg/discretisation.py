"""What a mesh does to λ/μ: bodies of known stiffness, moved on a finer mesh and registered on this one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float
from rich.progress import track

from bayesreg import pipeline
from bayesreg.config import Config, load_config
from bayesreg.image import Image
from bayesreg.inference.diagnostics import dataset
from bayesreg.inference.laplace import find_mode, unravel
from bayesreg.inference.recalibration import least_bodies
from bayesreg.io import store
from bayesreg.io.meshing import MeshOptions, build_mesh, load_mesh, save_mesh
from bayesreg.mesh import TetMesh, signed_volumes
from bayesreg.model.options import ModelConfig, of_tissue
from bayesreg.model.posterior import Posterior, build_posterior
from bayesreg.model.simulation import SyntheticPair, make_pair
from bayesreg.report.bodies import mesh_table
from bayesreg.report.tables import Table
from bayesreg.types import InputError

# λ/μ of the bodies, log-uniform, and how far their μ may lie from that of the registration, as a factor.
LOG_RATIOS, FACTOR = (math.log(2), math.log(100)), 1.5
# Of the finer mesh's edges to those of the registering one.
FINER = 0.6
# Directions that are tried for one body: along some a tetrahedron inverts, or the skull is in the way.
ATTEMPTS = 30
# Least displacement of a patch, mm, and its share of the nodes on the boundary.
LEAST_PUSH, PATCH_SHARE = 5.0, 0.045
CSF = "csf"


class Subject(NamedTuple):
    """What the bodies of a mesh share.

    Attributes
    ----------
    fixed, tissue, skull : Image
        As `make_pair` takes them.
    making, registering : TetMesh
        A finer mesh, and the one in question.
    model : ModelConfig
        Of the registration.
    lam, mu : mapping
        Tissue name to the value of CSF, and to one about which those of the other tissues lie.
    displacement, noise_sd : float
        How far a patch moves at most, mm, and at least half as far; the noise on each image.
    """

    fixed: Image
    tissue: Image
    skull: Image
    making: TetMesh
    registering: TetMesh
    model: ModelConfig
    lam: Mapping[str, float]
    mu: Mapping[str, float]
    displacement: float
    noise_sd: float


class Body(NamedTuple):
    """One simulated registration.

    Attributes
    ----------
    seed : int
    true, found : dict
        Tissue name (but CSF) to λ/μ: of the body, and at the mode of its posterior on the registering mesh.
    inverted : int
        Tetrahedra turned inside out at that mode. If any, the search has failed.
    """

    seed: int
    true: dict[str, float]
    found: dict[str, float]
    inverted: int


def register_body(subject: Subject, seed: int) -> Body:
    """A body of random λ/μ, pushed somewhere, and what its registration finds.

    Without a skull: where a body slides along it, it may hold nodes of the registering mesh that lie a little outside.

    Raises
    ------
    InputError
        If no direction is found along which the body can be pushed.
    """
    rng = np.random.default_rng(seed)
    names, model = subject.registering.names, subject.model
    solid, known = [name for name in names if name != CSF], model.known(names)
    true = dict(zip(solid, np.exp(rng.uniform(*LOG_RATIOS, len(solid))).tolist(), strict=True))
    lam, mu = dict(subject.lam), dict(subject.mu)
    for name in solid:
        lam_known, mu_known = (of_tissue(model, known.get(parameter), name) for parameter in ("lam", "mu"))
        mu[name] *= FACTOR ** rng.uniform(-1, 1)
        mu[name] = mu_known or (lam_known / true[name] if lam_known else mu[name])
        lam[name] = true[name] * mu[name]
    pair = _pushed(subject, rng, *(np.array([values[name] for name in names]) for values in (lam, mu)))
    values, inverted = _mode(build_posterior(pair.fixed, pair.moving, subject.registering, model))
    ratio = np.asarray(values["lam"]) / np.asarray(values["mu"])
    return Body(seed, true, {name: float(ratio[names.index(name)]) for name in solid}, inverted)


def _pushed(
    subject: Subject,
    rng: np.random.Generator,
    lam: Float[np.ndarray, "tissues"],
    mu: Float[np.ndarray, "tissues"],
) -> SyntheticPair:
    """A pair with a patch of its own in the upper half, where the brain is free."""
    patch_nodes = max(round(PATCH_SHARE * len(subject.making.boundary)), 3)
    for _ in range(ATTEMPTS):
        direction = rng.normal(size=3)
        direction[2] = abs(direction[2]) + 0.2 * np.linalg.norm(direction)
        try:
            return make_pair(
                *subject[:4],
                lam=lam,
                mu=mu,
                displacement=subject.displacement * rng.uniform(0.5, 1),
                patch_nodes=patch_nodes,
                direction=tuple(direction.tolist()),
                noise_sd=subject.noise_sd,
                seed=int(rng.integers(2**31)),
            )
        except InputError as error:
            last = error
    raise InputError(f"no patch can be pushed by {subject.displacement:.1f} mm; the last attempt: {last}") from last


def _mode(posterior: Posterior) -> tuple[dict[str, Any], int]:
    """Values at the mode, and how many tetrahedra it turns inside out."""
    rest = np.asarray(ravel_pytree(posterior.unconstrain(posterior.reference()))[0])
    values = posterior.constrain(unravel(posterior)(jnp.asarray(find_mode(posterior, rest))))
    mesh, u = posterior.mesh, np.asarray(posterior.evaluate(values).u)
    return values, int((signed_volumes(mesh.points + u, mesh.cells) <= 0).sum())


def mesh_error(folder: str | Path, bodies: int = 24, progress: bool = True) -> Table:
    """How far λ/μ of a finished run may be the mesh's own, by simulation; the report is written anew with it.

    Bodies of random λ/μ are pushed on a finer mesh and registered on the run's. They are kept in the folder: what was
    cut off goes on, and more can be added.

    Parameters
    ----------
    folder : path
        Of a finished run with elasticity by tissue and an intracranial mask.
    bodies : int
        How many to simulate in all.
    progress : bool
        Show a progress bar.

    Returns
    -------
    Table
        λ/μ as the run has it, and allowing for the mesh.

    Raises
    ------
    InputError
        If the folder holds no such run, or there are too few bodies.
    """
    result = pipeline.load_result(folder)
    config = load_config(Path(folder) / "config.yaml")
    _require_ratios(result, config)
    least = least_bodies(len(result.mesh.names) - 1)
    if bodies < least:
        raise InputError(f"bodies must be at least {least}, got {bodies}")
    found = list(result.run.bodies or [])
    subject = _subject(result, config)
    for seed in track(range(len(found), bodies), "bodies", disable=not progress):
        found.append(register_body(subject, seed)._asdict())
        store.write_bodies(folder, found)
    pipeline.report(folder)
    return mesh_table(result.mesh, dataset(result.idata, "posterior"), found)


def _require_ratios(result: pipeline.Result, config: Config) -> None:
    """Raise InputError where a run has no λ/μ by tissue that could be the mesh's, or no body can be pushed."""
    names = result.mesh.names
    if config.model.elasticity != "tissue" or CSF not in names:
        raise InputError("the mesh's share is that of λ/μ by tissue: the run needs elasticity: tissue, and a CSF")
    if result.run.skull is None:
        raise InputError("bodies are pushed inside the skull: the run needs an intracranial mask (data.intracranial)")


def _subject(result: pipeline.Result, config: Config) -> Subject:
    run, draws = result.run, dataset(result.idata, "posterior")
    assert run.skull is not None
    median = {name: draws[name].median(("chain", "draw")).to_numpy() for name in ("lam", "mu")}
    lam, mu = (dict(zip(run.mesh.names, median[name].tolist(), strict=True)) for name in ("lam", "mu"))
    moved = np.linalg.norm(np.asarray(run.u_mean)[run.mesh.boundary], axis=1).max()
    return Subject(
        fixed=run.fixed,
        tissue=run.tissue,
        skull=run.skull,
        making=_finer(result, config),
        registering=run.mesh,
        model=config.model,
        lam=lam,
        mu=mu,
        displacement=max(float(moved), LEAST_PUSH),
        noise_sd=float(run.manifest["implied_noise_sd"]) / np.sqrt(2),
    )


def _finer(result: pipeline.Result, config: Config) -> TetMesh:
    """The mesh that makes the bodies; kept with the run, since none is made twice alike."""
    path = Path(result.folder) / "inputs" / "finer.vtu"
    if not path.exists():
        run = result.run
        assert run.skull is not None
        domain = run.tissue.with_voxels((np.asarray(run.tissue.voxels) != 0).astype(np.uint8))
        intracranial = run.skull.with_voxels((np.asarray(run.skull.voxels) == 0).astype(np.uint8))
        options = MeshOptions(edge_length=FINER * config.mesh.edge_length, skull_gap=config.mesh.skull_gap)
        save_mesh(build_mesh(run.tissue, intracranial, options, domain), path)
    return load_mesh(path)
