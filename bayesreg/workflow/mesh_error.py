"""The error that the mesh of a run makes in its λ/μ, by simulated bodies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.progress import track

from bayesreg.config import model_of
from bayesreg.inference.draws.inference_data import dataset
from bayesreg.io import store
from bayesreg.io.ledger import locked
from bayesreg.io.meshing import MeshOptions, build_mesh, load_mesh, save_mesh
from bayesreg.mesh import TetMesh
from bayesreg.report.bodies import allowing, enough, mesh_table, sound
from bayesreg.report.tables import Table
from bayesreg.synthetic.bodies import Subject, register_body, sought_tissues
from bayesreg.synthetic.recalibration import least_bodies
from bayesreg.types import InputError
from bayesreg.workflow.result import Result, load_result, report

# Ratio of the finer mesh's edges to those of the registering one.
FINER = 0.6


def mesh_error(folder: str | Path, bodies: int = 24, progress: bool = True) -> Table:
    """How far λ/μ of a finished run may be the mesh's own, by simulation; the report is written anew with it.

    Bodies of random λ/μ are pushed on a finer mesh and registered on the run's. They are kept in the folder: what was
    cut off goes on, and more can be added.

    Parameters
    ----------
    folder : path
        Folder of a finished run with elasticity by tissue, a boundary that is sampled, and an intracranial mask.
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
    result = load_result(folder)
    _require_ratios(result)
    least = least_bodies(len(sought_tissues(model_of(result.run.config), result.mesh.names)))
    if bodies < least:
        raise InputError(f"bodies must be at least {least}, got {bodies}")
    found = list(result.run.bodies or [])
    subject = _subject(result)
    with locked(folder):
        for seed in track(range(len(found), bodies), "bodies", disable=not progress):
            found.append(register_body(subject, seed)._asdict())
            store.write_bodies(folder, found)
    if not enough(found):
        why = next(body["failed"] for body in reversed(found) if body["failed"])
        raise InputError(f"only {len(sound(found))} of {len(found)} bodies are registered, {least} are needed; {why}")
    report(folder)
    return mesh_table(allowing(result.mesh, dataset(result.idata, "posterior"), found))


def _require_ratios(result: Result) -> None:
    """Raise InputError where a run has no λ/μ by tissue that could be the mesh's, or no body can be pushed."""
    run, model = result.run, model_of(result.run.config)
    if model.elasticity != "tissue" or not sought_tissues(model, run.mesh.names):
        raise InputError(
            "the mesh errs in λ/μ by tissue: the run needs elasticity: tissue, and a solid tissue of which λ or μ is "
            "free"
        )
    if run.boundary is not None or model.elastic_prior.held or model.elastic_prior.samples_no_node:
        raise InputError("bodies move elsewhere than the run: its nodes must not be held (known_boundary, model.held)")
    if list(run.manifest["observations"]) != ["images"]:
        raise InputError(
            "bodies are registered by one pair of images: the run must have observed nothing else; this one observed "
            f"{', '.join(run.manifest['observations'])}"
        )
    if run.skull is None:
        raise InputError("bodies are pushed inside the skull: the run needs an intracranial mask (data.intracranial)")
    if run.manifest.get("inverted_elements"):
        raise InputError("the run's own mean displacement turns tetrahedra inside out: its λ/μ cannot be mended")


def _subject(result: Result) -> Subject:
    run, draws = result.run, dataset(result.idata, "posterior")
    assert run.skull is not None
    assert run.fixed is not None
    median = {name: draws[name].median(("chain", "draw")).to_numpy() for name in ("lam", "mu")}
    lam, mu = (dict(zip(run.mesh.names, median[name].tolist(), strict=True)) for name in ("lam", "mu"))
    return Subject(
        fixed=run.fixed,
        tissue=run.tissue,
        skull=run.skull,
        making=_finer(result),
        registering=run.mesh,
        model=model_of(result.run.config),
        image_options=run.manifest["observations"]["images"]["options"],
        lam=lam,
        mu=mu,
        displacement=float(np.linalg.norm(np.asarray(run.u_mean)[run.mesh.boundary], axis=1).max()),
        noise_sd=float(run.manifest["observations"]["images"]["noise_sd"]) / np.sqrt(2),
        # The image of a synthetic pair has been smoothed already.
        smoothing_mm=0.0 if run.manifest.get("pair") else 0.75,
    )


def _finer(result: Result) -> TetMesh:
    """The mesh that makes the bodies; kept with the run, since none is made twice alike."""
    path = Path(result.folder) / "inputs" / "finer.vtu"
    if not path.exists():
        run = result.run
        assert run.skull is not None
        domain = run.tissue.with_voxels((np.asarray(run.tissue.voxels) != 0).astype(np.uint8))
        intracranial = run.skull.with_voxels((np.asarray(run.skull.voxels) == 0).astype(np.uint8))
        options = MeshOptions(edge_length=FINER * _edge_length(run.mesh))
        save_mesh(build_mesh(run.tissue, intracranial, options, domain, run.mesh.names), path)
    return load_mesh(path)


def _edge_length(mesh: TetMesh) -> float:
    """Median length of an edge on the boundary, mm."""
    corners = mesh.points[mesh.boundary_faces]
    return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
