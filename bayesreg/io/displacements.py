"""Readers of displacements: of the nodes of a mesh (.npz, .vtu), or a field on a grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayesreg.io.atomic import load_arrays
from bayesreg.io.fields import load_displacement
from bayesreg.io.surface_files import read_dataset
from bayesreg.mesh import TetMesh
from bayesreg.pose import Pose
from bayesreg.types import InputError

# Files with these suffixes hold displacements of the nodes of a mesh; all other files hold a field on a grid.
NODAL_SUFFIXES = (".npz", ".vtu")
IDENTITY = Pose.identity()
# A field ends at a point if zeros in the voxels beside the point reduce the displacement by more than this, mm.
ENDS = 0.25


def read_point_data(path: str | Path, *names: str) -> list[np.ndarray]:
    """Read named nodal arrays of a mesh file; raise InputError if one is missing."""
    data = _point_data(Path(path))
    missing = [name for name in names if name not in data]
    if missing:
        raise InputError(f"{path} holds no {' and no '.join(missing)}: the run has not been finished")
    return [np.asarray(data[name], float) for name in names]


def read_start(path: Path, mesh: TetMesh, pose: Pose) -> Float[np.ndarray, "nodes 3"]:
    """Read the displacement of every node, mm, from which a search starts.

    Parameters
    ----------
    path : path
        A file of all nodes (`read_displacement`), or a displacement field on a grid. A field is interpolated linearly;
        beyond its grid the values at the border hold. A field maps the fixed image's world to the moving image's world;
        the pose is then removed. Nodal displacements do not include the pose.
    mesh : TetMesh
    pose : Pose

    Raises
    ------
    InputError
        As in `read_displacement` and `bayesreg.io.fields.load_displacement`.
    """
    if not _is_volume(path):
        return read_displacement(path, mesh)
    displacement = np.stack(
        [np.asarray(component.interpolate(mesh.points)) for component in load_displacement(path)], axis=1
    )
    return pose.inverse.place(mesh.points + displacement) - mesh.points


def read_displacement(path: Path, mesh: TetMesh | None = None) -> Float[np.ndarray, "nodes 3"]:
    """Read the displacement of every node, mm: array "u" or "u_mean" of an .npz file or a .vtu mesh.

    Parameters
    ----------
    path : path
    mesh : TetMesh, optional
        The displacement must have one row per node of this mesh; None if there is no mesh yet.

    Raises
    ------
    InputError
        If the file holds no displacement, or one for another mesh.
    """
    data = load_arrays(path, "give another file") if path.suffix == ".npz" else _point_data(path)
    displacements = [data[name] for name in ("u", "u_mean") if name in data]
    if not displacements:
        raise InputError(f"{path} holds no displacement: expected an array named 'u', got {', '.join(data) or 'none'}")
    shape = np.shape(displacements[0])
    if shape[1:] != (3,) or (mesh is not None and len(mesh.points) != shape[0]):
        rows = "n" if mesh is None else len(mesh.points)
        raise InputError(
            f"the displacement in {path} has shape {shape}; expected ({rows}, 3), one row per node of the run's mesh"
        )
    if displacements[0].dtype.kind not in "fiu" or not np.isfinite(displacements[0]).all():
        raise InputError(f"the displacement in {path} must consist of finite numbers")
    return np.asarray(displacements[0], float)


def require_displacement(path: Path, mesh: TetMesh | None = None) -> None:
    """Raise InputError if a file holds no displacement, of nodes (.npz, .vtu) or on a grid."""
    load_displacement(path) if _is_volume(path) else read_displacement(path, mesh)


def read_boundary(path: Path, mesh: TetMesh, pose: Pose = IDENTITY) -> Float[np.ndarray, "boundary 3"]:
    """Read the displacement of the boundary nodes from a file of all nodes (.npz, .vtu) or a field on a grid.

    Parameters
    ----------
    path : path
        A field on a grid (`bayesreg.io.fields.load_displacement`) is interpolated linearly.
    mesh : TetMesh
    pose : Pose
        As in `read_start`.

    Raises
    ------
    InputError
        If the file holds no displacement or one for another mesh, the field's grid does not reach the boundary,
        or the field jumps to zero at the boundary.
    """
    if not _is_volume(path):
        return read_displacement(path, mesh)[mesh.boundary]
    components = load_displacement(path)
    places = mesh.points[mesh.boundary]
    off_grid = ~components[0].contains(places)
    if off_grid.any():
        raise InputError(
            f"the displacement field {path} does not reach {int(off_grid.sum())} of the {len(places)} boundary nodes: "
            f"they lie off its grid, the first at {places[off_grid][0].round(1).tolist()} mm"
        )
    defined = components[0].with_voxels(
        np.any([np.asarray(component.voxels) != 0 for component in components], axis=0) * 1.0
    )
    displacement = np.stack([np.asarray(component.interpolate(places)) for component in components], axis=1)
    # Zeros beside a point reduce the interpolated value by the share of nonzero voxels; a field that decreases
    # smoothly to zero has small values there.
    share = np.maximum(np.asarray(defined.interpolate(places)), 1e-9)
    ends = np.linalg.norm(displacement, axis=1) * (1 - share) / share > ENDS
    if ends.any():
        raise InputError(
            f"the displacement field {path} ends at {int(ends.sum())} of the {len(places)} boundary nodes: it is zero "
            f"in voxels beside them, first at {places[ends][0].round(1).tolist()} mm, as where it is known inside the "
            "organ alone; give one that goes on beyond the boundary, or a run's mesh.vtu"
        )
    return pose.inverse.place(places + displacement) - places


def _is_volume(path: Path) -> bool:
    """Decide by the name of a file whether it holds a field on a grid or displacements of nodes."""
    return not path.name.lower().endswith(NODAL_SUFFIXES)


def _point_data(path: Path) -> dict[str, np.ndarray]:
    try:
        return {name: np.asarray(values) for name, values in read_dataset(path).point_data.items()}
    except ValueError as error:
        raise InputError(f"{path} cannot be read as a .vtu mesh: {error}") from error
