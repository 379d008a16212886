"""The run folder: inputs, results, and the checkpoints that a killed run continues from."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayesreg.image import Image
from bayesreg.io.atomic import load_arrays, read_json, save_arrays, write_json, write_text
from bayesreg.io.displacements import read_point_data
from bayesreg.io.meshing import load_mesh, save_mesh
from bayesreg.io.volumes import load_image, save_displacement, save_image
from bayesreg.mesh import TetMesh
from bayesreg.types import AnyArray, InputError

BODIES = "bodies.json"
RESULTS = (
    "config.yaml", "run.json", "mesh.vtu", "posterior.nc", "draws", "state.npz", "inputs", "report.html", BODIES,
)  # fmt: skip
RESUME_ANEW = "delete state.npz in that run's folder, and it resumes from its first step"
_BODY = {"seed", "true", "found", "failed"}


class Truth(NamedTuple):
    """What is known of a synthetic pair.

    Attributes
    ----------
    u : (n, 3) array
        True displacement of every node of the run's mesh, mm.
    lam, mu : (T,) array
        True Lamé parameters by tissue.
    initial : (n, 3) array or None
        Centre of the displacements that the chains started from, mm; None for the identity.
    """

    u: AnyArray
    lam: AnyArray
    mu: AnyArray
    initial: AnyArray | None = None


class Predicted(NamedTuple):
    """What was computed of thinned draws at the end of a run, since it needs the posterior itself.

    Attributes
    ----------
    chain_mean : (chains, n, 3) array
        Mean displacement of every node, mm, chain by chain.
    far_mm : scalar
    far : (n,) array
        P(|u − ū| > far_mm) at every node, ū the posterior mean.
    reach : (n,) array
        |u − ū|, mm, that 95 % of the draws do not exceed.
    place_names : (L,) array of str
    place_points : (L, 3) array
        World mm, in the fixed image.
    place_draws : (chains, draws, L, 3) array
        Displacement of the places, mm.
    residual : (q,) array
        f − m(x + ū) at the quadrature points over the noise sd that T_s implies there.
    residual_tissue : (q,) int array
        Index into the mesh's tissue names.
    discrepancies : (D,) array of str
    observed, replicated : (chains, draws, D) arrays
        Discrepancies of the standardised residuals of each draw, and of noise that follows the model.
    stiffness_mean, stiffness_sd : (m,) array or None
        Posterior mean and standard deviation of every element's stiffness over its tissue's; None without a field.
    stiffer : scalar or None
    stiffer_probability : (m,) array or None
        P(stiffness over the tissue's > stiffer).
    """

    chain_mean: AnyArray
    far_mm: AnyArray
    far: AnyArray
    reach: AnyArray
    place_names: np.ndarray
    place_points: AnyArray
    place_draws: AnyArray
    residual: AnyArray
    residual_tissue: AnyArray
    discrepancies: np.ndarray
    observed: AnyArray
    replicated: AnyArray
    stiffness_mean: AnyArray | None = None
    stiffness_sd: AnyArray | None = None
    stiffer: AnyArray | None = None
    stiffer_probability: AnyArray | None = None

    @property
    def known(self) -> dict[str, AnyArray]:
        """Those of the entries that there are."""
        return {name: value for name, value in self._asdict().items() if value is not None}

    @property
    def by_cell(self) -> dict[str, AnyArray]:
        """Those that have one row per element."""
        fields = ("stiffness_mean", "stiffness_sd", "stiffer_probability")
        return {name: value for name, value in self.known.items() if name in fields}


class Inputs(NamedTuple):
    """What a run starts from, and what a resumed run must find unchanged.

    Attributes
    ----------
    config : str
        The resolved configuration, YAML.
    mesh : TetMesh
    fixed, moving : Image
        As the model saw them (one common intensity scale).
    tissue : Image
        Tissue labels on a grid of the fixed space, 0 outside, 1 + index into `mesh.names` inside.
    skull : Image or None
        Nonzero where no sampled node may go.
    truth : Truth or None
    boundary : (b, 3) array or None
        Displacement of the boundary nodes, mm, where it is known and not sampled.
    """

    config: str
    mesh: TetMesh
    fixed: Image
    moving: Image
    tissue: Image
    skull: Image | None = None
    truth: Truth | None = None
    boundary: AnyArray | None = None


@dataclass(frozen=True, eq=False)
class Run:
    """A finished run in memory; its draws travel beside it.

    Attributes
    ----------
    config, mesh, fixed, moving, tissue, skull, truth, boundary
        As in `Inputs`.
    manifest : dict
        The content of run.json.
    u_mean, u_sd : (n, 3) array
        Posterior mean and standard deviation of the displacement of every node, mm.
    warped : Image
        Moving image resampled on the fixed grid by the posterior mean.
    metrics : dict or None
        The content of metrics.json, where the truth is known.
    predicted : Predicted or None
        The content of predicted.npz; None for runs of versions that wrote none.
    bodies : list of dict or None
        The content of bodies.json, simulated registrations on this mesh; None where there were none.
    """

    config: str
    manifest: dict[str, Any]
    mesh: TetMesh
    u_mean: Float[AnyArray, "nodes 3"]
    u_sd: Float[AnyArray, "nodes 3"]
    fixed: Image
    moving: Image
    tissue: Image
    warped: Image
    skull: Image | None = None
    truth: Truth | None = None
    boundary: AnyArray | None = None
    metrics: dict[str, Any] | None = None
    predicted: Predicted | None = None
    bodies: list[dict[str, Any]] | None = None


def require_fresh(folder: str | Path) -> None:
    """Raise InputError where a folder (or a file in its place) already holds a run, or cannot be written."""
    folder = Path(folder)
    nearest = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if folder.exists() and not folder.is_dir():
        raise InputError(f"the output folder {folder} is a file; name a folder that is new or empty")
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"the output folder {folder} cannot be written: {nearest} is no folder that you may write")
    held = [name for name in RESULTS if (folder / name).exists()]
    if held:
        raise InputError(
            f"the output folder {folder} already holds a run ({', '.join(held)}); "
            "name another folder, or continue that run with --resume"
        )


def write_inputs(folder: str | Path, inputs: Inputs) -> None:
    """Write config.yaml, mesh.vtu and inputs/ into a folder, which is made if need be."""
    folder = Path(folder)
    images = folder / "inputs"
    images.mkdir(parents=True, exist_ok=True)
    names = [name for name in ("fixed", "moving", "tissue", "skull") if getattr(inputs, name) is not None]
    # What compresses lets other threads run.
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda name: save_image(getattr(inputs, name), images / f"{name}.nii.gz"), names))
    if inputs.truth is not None:
        known = {key: value for key, value in inputs.truth._asdict().items() if value is not None}
        save_arrays(images / "truth.npz", known)
    if inputs.boundary is not None:
        save_arrays(images / "boundary.npz", {"u_boundary": inputs.boundary})
    save_mesh(inputs.mesh, folder / "mesh.vtu")
    write_text(folder / "config.yaml", inputs.config)


def read_inputs(folder: str | Path) -> Inputs:
    """Read what `write_inputs` wrote; InputError where a part is missing or unreadable."""
    folder = Path(folder)
    images = folder / "inputs"
    config = _require(folder, "config.yaml").read_text(encoding="utf-8")
    mesh = load_mesh(_require(folder, "mesh.vtu"))
    fixed, moving, tissue = (
        load_image(_require(folder, f"inputs/{name}.nii.gz")) for name in ("fixed", "moving", "tissue")
    )
    skull = load_image(images / "skull.nii.gz") if (images / "skull.nii.gz").exists() else None
    known, given = images / "truth.npz", images / "boundary.npz"
    truth = Truth(**load_arrays(known, "run anew, into another folder")) if known.exists() else None
    boundary = load_arrays(given, "run anew, into another folder")["u_boundary"] if given.exists() else None
    return Inputs(config, mesh, fixed, moving, tissue, skull, truth, boundary)


def write_results(
    folder: str | Path,
    run: Run,
    displacement_mean: Float[np.ndarray, "X Y Z 3"],
    displacement_sd: Float[np.ndarray, "X Y Z 3"],
) -> None:
    """Write what a finished run adds to its inputs, run.json last.

    Parameters
    ----------
    folder : path
        Where `write_inputs` has written; files of the same names are replaced, each in one step.
    run : Run
    displacement_mean, displacement_sd : (X, Y, Z, 3) arrays
        Posterior mean and standard deviation of u on the fixed grid, world RAS, mm. The mean is written as a
        resampling transform (LPS vectors, intent 1007), the standard deviation as positive vectors.
    """
    folder = Path(folder)
    by_cell = {} if run.predicted is None else run.predicted.by_cell
    save_mesh(run.mesh, folder / "mesh.vtu", {"u_mean": run.u_mean, "u_sd": run.u_sd}, by_cell)
    save_image(run.warped, folder / "warped_mean.nii.gz")
    save_displacement(folder / "displacement_mean.nii.gz", displacement_mean, run.fixed.affine)
    # The writer turns x and y round, from RAS to LPS; a standard deviation has no sign to turn.
    unsigned = np.asarray(displacement_sd) * (-1.0, -1.0, 1.0)
    save_displacement(folder / "displacement_sd.nii.gz", unsigned, run.fixed.affine)
    if run.metrics is not None:
        write_json(folder / "metrics.json", run.metrics)
    if run.predicted is not None:
        save_arrays(folder / "predicted.npz", run.predicted.known)
    write_json(folder / "run.json", run.manifest)


def read_run(folder: str | Path) -> Run:
    """Read what `write_inputs` and `write_results` wrote.

    Raises
    ------
    InputError
        If the folder holds no finished run, or a part of it is missing or unreadable.
    """
    folder = Path(folder)
    manifest = read_json(_require(folder, "run.json"))
    inputs = read_inputs(folder)
    u_mean, u_sd = read_point_data(folder / "mesh.vtu", "u_mean", "u_sd")
    warped = load_image(_require(folder, "warped_mean.nii.gz"))
    metrics = read_json(folder / "metrics.json") if (folder / "metrics.json").exists() else None
    known = folder / "predicted.npz"
    predicted = Predicted(**load_arrays(known, "run anew, into another folder")) if known.exists() else None
    return Run(
        manifest=manifest,
        u_mean=u_mean,
        u_sd=u_sd,
        warped=warped,
        metrics=metrics,
        predicted=predicted,
        bodies=read_bodies(folder),
        **inputs._asdict(),
    )


def write_bodies(folder: str | Path, bodies: Sequence[Mapping[str, Any]]) -> None:
    """Write bodies.json of a run: simulated registrations on its mesh."""
    write_json(Path(folder) / BODIES, list(bodies))


def read_bodies(folder: str | Path) -> list[dict[str, Any]] | None:
    """Read what `write_bodies` wrote; None where nothing was, InputError where it is damaged."""
    path = Path(folder) / BODIES
    if not path.exists():
        return None
    bodies = read_json(path)
    whole = isinstance(bodies, list) and all(isinstance(body, dict) and body.keys() >= _BODY for body in bodies)
    if not whole:
        raise InputError(f"{path} holds no simulated bodies; remove it, and they are simulated anew")
    return bodies


def save_block(folder: str | Path, index: int, arrays: Mapping[str, AnyArray]) -> None:
    """Write one block of draws in one step; a block of the same index is replaced."""
    path = _block_path(folder, index)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_arrays(path, arrays)


class StoredBlocks:
    """The first blocks of draws in draws/ of a run folder, each read when it is asked for; see `save_block`.

    Parameters
    ----------
    folder : path
    count : int
    writes : bool
        False where another process writes what is appended.

    Raises
    ------
    InputError
        If one is missing or, when it is asked for, damaged.
    """

    def __init__(self, folder: str | Path, count: int, writes: bool = True) -> None:
        self.folder, self.count, self.writes = Path(folder), count, writes
        for index in range(count):
            if not _block_path(self.folder, index).exists():
                raise InputError(f"{_block_path(self.folder, index)} is missing; {RESUME_ANEW}")

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int, /) -> dict[str, np.ndarray]:
        if not 0 <= index < self.count:
            raise IndexError(f"block {index} of {self.count}")
        return load_arrays(_block_path(self.folder, index), RESUME_ANEW)

    def __iter__(self) -> Iterator[dict[str, np.ndarray]]:
        return (self[index] for index in range(self.count))

    def append(self, block: Mapping[str, AnyArray], /) -> None:
        """Write one block more."""
        if self.writes:
            save_block(self.folder, self.count, block)
        self.count += 1


def _block_path(folder: str | Path, index: int) -> Path:
    return Path(folder) / "draws" / f"block_{index:05d}.npz"


def save_state(folder: str | Path, arrays: Mapping[str, AnyArray]) -> None:
    """Replace state.npz, what the next block starts from, in one step."""
    save_arrays(Path(folder) / "state.npz", arrays)


def load_state(folder: str | Path) -> dict[str, np.ndarray] | None:
    """The content of state.npz; None where there is none."""
    path = Path(folder) / "state.npz"
    return load_arrays(path, "delete it, and the run resumes from its first step") if path.exists() else None


def remove_blocks(folder: str | Path) -> None:
    """Remove draws/ of a run whose results are complete; state.npz stays, from which it can be continued."""
    shutil.rmtree(Path(folder) / "draws", ignore_errors=True)


def reopen(folder: str | Path, blocks: Iterable[Mapping[str, AnyArray]]) -> None:
    """Make of a finished run one that was cut off after these blocks, which hold all its draws.

    Killed between any two of its steps, it leaves a finished run, or what it is to leave.

    Raises
    ------
    InputError
        If the run's last state was not kept.
    """
    folder = Path(folder)
    state = load_state(folder)
    if state is None:
        raise InputError(f"{folder} cannot be continued: state.npz, where its chains stood last, is missing")
    kept = StoredBlocks(folder, 0)
    for block in blocks:
        kept.append(block)
    save_state(folder, state | {"blocks": np.array(len(kept))})
    (folder / "run.json").unlink()


def _require(folder: Path, name: str) -> Path:
    if not (folder / name).exists():
        raise InputError(f"{folder} holds no finished run: {name} is missing")
    return folder / name
