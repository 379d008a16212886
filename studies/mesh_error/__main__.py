"""What does the mesh of a run do to its λ/μ?

    python -m studies.mesh_error RUN -o DIR [--bodies 24]

Bodies of random λ/μ are pushed on a finer mesh and registered on the run's mesh (docs/model.md#λμ-and-the-mesh). The
program prints λ/μ as the run found it, and λ/μ corrected for the mesh. DIR/ratios.svg shows both, with the bodies. DIR
keeps the bodies, so that an interrupted study continues, and a greater --bodies adds more.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from bayesreg.config import model_of
from bayesreg.inference.draws.inference_data import dataset
from bayesreg.io.atomic import read_json, write_json
from bayesreg.io.meshing import MeshOptions, build_mesh, load_mesh, save_mesh
from bayesreg.mesh import TetMesh
from bayesreg.report.tables import Table
from bayesreg.results.result import Result, load_result
from bayesreg.types import InputError
from studies.mesh_error.bodies import Subject, register_body, sought_tissues
from studies.mesh_error.ratios import correct_for_mesh, draw_ratios, enough, mesh_table, sound
from studies.mesh_error.recalibration import least_bodies
from studies.terminal import in_terminal

BODIES = "bodies.json"
# Ratio of the finer mesh's edges to those of the registering one.
FINER = 0.6


def mesh_error(folder: str | Path, out: str | Path, bodies: int = 24, progress: bool = True) -> Table:
    """Measure by simulation how much the mesh of a finished run changes its λ/μ.

    Parameters
    ----------
    folder : path
        Folder of a finished run with elasticity by tissue, a sampled boundary and an intracranial mask.
    out : path
        A folder for the bodies (bodies.json), their mesh (finer.vtu) and the figure (ratios.svg).
    bodies : int
        How many to simulate in all.
    progress : bool
        Show a progress bar.

    Returns
    -------
    Table
        λ/μ as the run found it, and corrected for the mesh.

    Raises
    ------
    InputError
        If the folder holds no such run, `bodies` is too small, or too many registrations fail.
    """
    result, out = load_result(folder), Path(out)
    _require_ratios(result)
    least = least_bodies(len(sought_tissues(model_of(result.run.config), result.mesh.names)))
    if bodies < least:
        raise InputError(f"bodies must be at least {least}, got {bodies}")
    out.mkdir(parents=True, exist_ok=True)
    registered = read_json(out / BODIES) if (out / BODIES).exists() else []
    subject = _subject(result, _finer(result, out))
    for seed in track(range(len(registered), bodies), "bodies", disable=not progress):
        registered.append(register_body(subject, seed)._asdict())
        write_json(out / BODIES, registered)
    if not enough(registered):
        reason = next(body["failed"] for body in reversed(registered) if body["failed"])
        raise InputError(
            f"only {len(sound(registered))} of {len(registered)} bodies are registered, {least} are needed; {reason}"
        )
    correction = correct_for_mesh(result.mesh, dataset(result.idata, "posterior"), registered)
    draw_ratios(correction).savefig(out / "ratios.svg")
    return mesh_table(correction)


def _require_ratios(result: Result) -> None:
    """Raise InputError if the run does not sample λ/μ by tissue, or if no body can be pushed."""
    run, model = result.run, model_of(result.run.config)
    if model.elasticity != "tissue" or not sought_tissues(model, run.mesh.names):
        raise InputError(
            "the mesh errs in λ/μ by tissue: the run needs elasticity: tissue, and a solid tissue of which λ or μ is "
            "free"
        )
    if run.boundary is not None or model.elastic_prior.held or model.elastic_prior.samples_no_node:
        raise InputError(
            "bodies move elsewhere than the run: its nodes must not be held (known_boundary, model.elastic_prior.held)"
        )
    if list(run.manifest["observations"]) != ["images"]:
        raise InputError(
            "bodies are registered by one pair of images: the run must have observed nothing else; this one observed "
            f"{', '.join(run.manifest['observations'])}"
        )
    if run.skull is None:
        raise InputError("bodies are pushed inside the skull: the run needs an intracranial mask (data.intracranial)")
    if run.manifest.get("inverted_elements"):
        raise InputError("the run's own mean displacement turns tetrahedra inside out: its λ/μ cannot be mended")


def _subject(result: Result, making: TetMesh) -> Subject:
    run, draws = result.run, dataset(result.idata, "posterior")
    assert run.skull is not None
    assert run.fixed is not None
    median = {name: draws[name].median(("chain", "draw")).to_numpy() for name in ("lam", "mu")}
    lam, mu = (dict(zip(run.mesh.names, median[name].tolist(), strict=True)) for name in ("lam", "mu"))
    return Subject(
        fixed=run.fixed,
        tissue=run.tissue,
        skull=run.skull,
        making=making,
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


def _finer(result: Result, out: Path) -> TetMesh:
    """The mesh that makes the bodies; it is stored, because meshing is not deterministic."""
    path = out / "finer.vtu"
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


def main() -> None:
    """Read the command line, simulate, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m studies.mesh_error")
    parser.add_argument("run", metavar="RUN", help="folder of a finished run")
    parser.add_argument("-o", "--out", required=True, metavar="DIR")
    parser.add_argument("--bodies", type=int, default=24, help="how many to simulate in all")
    arguments = parser.parse_args()
    table = mesh_error(arguments.run, arguments.out, arguments.bodies)
    Console().print(in_terminal(table), table.caption)


if __name__ == "__main__":
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", ".jax_cache")
    main()
