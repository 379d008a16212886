"""What a mesh does to λ/μ: bodies of known stiffness, moved on a finer mesh and registered on this one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float
from rich.progress import track

from bayesreg import pipeline
from bayesreg.config import model_of
from bayesreg.image import Image
from bayesreg.inference.draws import dataset
from bayesreg.inference.layout import unravel
from bayesreg.inference.mode_search import find_mode
from bayesreg.inference.recalibration import RANGE, least_bodies
from bayesreg.io import store
from bayesreg.io.meshing import MeshOptions, build_mesh, load_mesh, save_mesh
from bayesreg.mesh import TetMesh, signed_volumes
from bayesreg.model.options import ModelConfig, of_tissue
from bayesreg.model.posterior import Posterior, build_posterior
from bayesreg.model.simulation import SyntheticPair, make_pair
from bayesreg.report.bodies import allowing, enough, mesh_table, sound
from bayesreg.report.tables import Table
from bayesreg.types import InputError

# How far the μ of a body may lie from that of the run, as a factor, and its push, as a share of the run's.
FACTOR, PUSH = 1.5, (0.85, 1.15)
# Of the finer mesh's edges to those of the registering one.
FINER = 0.6
# Directions that are tried for one body: along some a tetrahedron inverts, or the skull is in the way.
ATTEMPTS = 30
# Share of the nodes on the boundary that are pushed.
PATCH_SHARE = 0.045
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
    displacement, noise_sd, smoothing_mm : float
        How far a patch moves, mm; the noise on each image; the width of a smoothing of `fixed` beforehand.
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
    smoothing_mm: float = 0.75


class Body(NamedTuple):
    """One simulated registration.

    Attributes
    ----------
    seed : int
    true, found : dict
        Tissue to λ/μ, of the body and at the mode of its posterior on the registering mesh; of tissues whose λ/μ the
        registration has to find. CSF is none of them.
    failed : str
        Why the registration cannot be counted; empty if it can.
    """

    seed: int
    true: dict[str, float]
    found: dict[str, float]
    failed: str = ""


def sought(model: ModelConfig, names: tuple[str, ...]) -> list[str]:
    """Tissues but CSF of which λ or μ is free."""
    known = [model.known(names).get(parameter) for parameter in ("lam", "mu")]
    return [name for name in names if name != CSF and not all(of_tissue(model, given, name) for given in known)]


def register_body(subject: Subject, seed: int) -> Body:
    """A body of random λ/μ, pushed somewhere, and what its registration finds.

    Without a skull: where a body slides along it, it may hold nodes of the registering mesh that lie a little outside.
    """
    rng = np.random.default_rng(seed)
    names, model = subject.registering.names, subject.model
    lam, mu, known = dict(subject.lam), dict(subject.mu), model.known(names)
    low, high = np.log(RANGE)
    for name in names:
        ratio, factor = float(np.exp(rng.uniform(low, high))), FACTOR ** float(rng.uniform(-1, 1))
        lam_known, mu_known = (of_tissue(model, known.get(parameter), name) for parameter in ("lam", "mu"))
        if name != CSF:
            mu[name] = mu_known or (lam_known / ratio if lam_known else mu[name] * factor)
            lam[name] = lam_known or ratio * mu[name]
    tissues = sought(model, names)
    true = {name: lam[name] / mu[name] for name in tissues}
    try:
        pair = _pushed(subject, rng, *(np.array([values[name] for name in names]) for values in (lam, mu)))
        values, inverted = _mode(build_posterior(pair.fixed, pair.moving, subject.registering, model))
    except InputError as error:
        return Body(seed, true, {}, str(error))
    ratios = np.asarray(values["lam"]) / np.asarray(values["mu"])
    found = {name: float(ratios[names.index(name)]) for name in tissues}
    if inverted:
        return Body(seed, true, found, f"the search for the mode turned tetrahedra inside out ({inverted})")
    if not all(0 < ratio < np.inf for ratio in found.values()):
        return Body(seed, true, {}, "the search has no end")
    return Body(seed, true, found)


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
                displacement=subject.displacement * rng.uniform(*PUSH),
                patch_nodes=patch_nodes,
                direction=tuple(direction.tolist()),
                smoothing_mm=subject.smoothing_mm,
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
        Of a finished run with elasticity by tissue, a boundary that is sampled, and an intracranial mask.
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
        If the folder holds no such run, there are too few bodies, or the registrations of too many fail.
    """
    result = pipeline.load_result(folder)
    _require_ratios(result)
    least = least_bodies(len(sought(model_of(result.run.config), result.mesh.names)))
    if bodies < least:
        raise InputError(f"bodies must be at least {least}, got {bodies}")
    found = list(result.run.bodies or [])
    subject = _subject(result)
    for seed in track(range(len(found), bodies), "bodies", disable=not progress):
        found.append(register_body(subject, seed)._asdict())
        store.write_bodies(folder, found)
    if not enough(found):
        why = next(body["failed"] for body in reversed(found) if body["failed"])
        raise InputError(f"only {len(sound(found))} of {len(found)} bodies are registered, {least} are needed; {why}")
    pipeline.report(folder)
    return mesh_table(allowing(result.mesh, dataset(result.idata, "posterior"), found))


def _require_ratios(result: pipeline.Result) -> None:
    """Raise InputError where a run has no λ/μ by tissue that could be the mesh's, or no body can be pushed."""
    run, model = result.run, model_of(result.run.config)
    if model.elasticity != "tissue" or CSF not in run.mesh.names or not sought(model, run.mesh.names):
        raise InputError("the mesh's share is that of λ/μ by tissue: the run needs elasticity: tissue, and a CSF")
    if run.boundary is not None or model.held or model.is_elastography:
        raise InputError("bodies move elsewhere than the run: its nodes must not be held (known_boundary, model.held)")
    if run.skull is None:
        raise InputError("bodies are pushed inside the skull: the run needs an intracranial mask (data.intracranial)")
    if run.manifest.get("inverted_elements"):
        raise InputError("the run's own mean displacement turns tetrahedra inside out: its λ/μ cannot be mended")


def _subject(result: pipeline.Result) -> Subject:
    run, draws = result.run, dataset(result.idata, "posterior")
    assert run.skull is not None
    median = {name: draws[name].median(("chain", "draw")).to_numpy() for name in ("lam", "mu")}
    lam, mu = (dict(zip(run.mesh.names, median[name].tolist(), strict=True)) for name in ("lam", "mu"))
    return Subject(
        fixed=run.fixed,
        tissue=run.tissue,
        skull=run.skull,
        making=_finer(result),
        registering=run.mesh,
        model=model_of(result.run.config),
        lam=lam,
        mu=mu,
        displacement=float(np.linalg.norm(np.asarray(run.u_mean)[run.mesh.boundary], axis=1).max()),
        noise_sd=float(run.manifest["implied_noise_sd"]) / np.sqrt(2),
        # The image of a synthetic pair has been smoothed already.
        smoothing_mm=0.0 if run.manifest.get("pair") else 0.75,
    )


def _finer(result: pipeline.Result) -> TetMesh:
    """The mesh that makes the bodies; kept with the run, since none is made twice alike."""
    path = Path(result.folder) / "inputs" / "finer.vtu"
    if not path.exists():
        run = result.run
        assert run.skull is not None
        domain = run.tissue.with_voxels((np.asarray(run.tissue.voxels) != 0).astype(np.uint8))
        intracranial = run.skull.with_voxels((np.asarray(run.skull.voxels) == 0).astype(np.uint8))
        options = MeshOptions(edge_length=FINER * _edge_length(run.mesh))
        save_mesh(build_mesh(run.tissue, intracranial, options, domain), path)
    return load_mesh(path)


def _edge_length(mesh: TetMesh) -> float:
    """Median length of an edge on the boundary, mm."""
    corners = mesh.points[mesh.boundary_faces]
    return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
