"""A wrapper that runs fTetWild in a separate process.

fTetWild writes a file into the working directory, prints from native code, cannot be interrupted, and can crash without
an exception. The separate process protects the caller from this.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bayesreg.image import Image
from bayesreg.io.cells import cells_inside
from bayesreg.io.domain import MeshError
from bayesreg.io.surfaces import Sizing, Surface

_PROGRAM = """
import sys
import numpy as np
import pytetwild
given = {name: value[()] for name, value in np.load("in.npz").items()}
points, cells = pytetwild.tetrahedralize(**given, coarsen=True, vtk_ordering=True, disable_filtering=True,
                                        quiet=sys.argv[1] == "quiet")
np.savez("out.npz", points=points, cells=cells)
"""


def tetrahedralize(
    surfaces: list[Surface],
    field: Image,
    sizing: Sizing,
    *,
    envelope: float,
    stop_energy: float = 20.0,
    threads: int = 0,
    quiet: bool = True,
) -> tuple[Float[np.ndarray, "nodes 3"], Int[np.ndarray, "cells 4"]]:
    """Mesh the inside of surfaces by fTetWild; return points and positively oriented cells.

    fTetWild takes for outside where its surfaces wind in total less than once, which holds in a few tetrahedra where it
    joined an inner surface with the outer one. So it returns its whole box, and `cells_inside` chooses.

    fTetWild (Hu, Schneider, Wang, Zorin, Panozzo, "Fast Tetrahedral Meshing in the Wild", 2020) is not deterministic,
    even with one thread.

    Parameters
    ----------
    surfaces : list of Surface
        The mesh fills the first surface and has faces along all surfaces.
    field : Image
        Above 0.5 inside the first surface.
    sizing : Sizing
        Target edge length.
    envelope : float
        Largest distance of the mesh's faces from the surfaces, mm.
    stop_energy : float
        Quality (AMIPS energy, 3 at best) at which the optimisation may stop.
    threads : int
        Number of threads; 0 for all cores.
    quiet : bool
        Whether to suppress fTetWild's own output.

    Raises
    ------
    MeshError
        If fTetWild fails or returns nothing.
    """
    points = np.concatenate([surface.points for surface in surfaces])
    offsets = np.cumsum([0, *(len(surface.points) for surface in surfaces[:-1])])
    faces = np.concatenate([surface.faces + offset for surface, offset in zip(surfaces, offsets, strict=True)])
    arguments: dict[str, Any] = {
        "vertices": points,
        "faces": faces.astype(np.int32),
        "edge_length_abs": float(sizing.values.max()),
        "epsilon": envelope / np.linalg.norm(np.ptp(points, axis=0)),
        "stop_energy": stop_energy,
        "num_threads": threads,
        "bg_vertices": sizing.points,
        "bg_tets": sizing.cells.astype(np.int32),
        "bg_values": sizing.values,
    }
    points, cells = _run(arguments, quiet)
    return _renumbered(points, cells[cells_inside(points, cells, field)])


def _run(arguments: dict[str, Any], quiet: bool) -> tuple[np.ndarray, np.ndarray]:
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "in.npz", **arguments)
        command = [sys.executable, "-c", _PROGRAM, "quiet" if quiet else "loud"]
        done = subprocess.run(command, cwd=folder, capture_output=quiet, text=True, check=False)
        if done.returncode:
            words = (done.stderr or "no message").strip().splitlines()[-1]
            raise MeshError(f"fTetWild failed (exit {done.returncode}: {words}); try another edge_length or envelope")
        with np.load(Path(folder) / "out.npz") as result:
            points, cells = result["points"], result["cells"].astype(np.int64)
    return _renumbered(points.astype(float), cells)


def _renumbered(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if len(cells) == 0:
        raise MeshError("fTetWild returned an empty mesh; choose a shorter edge_length or a smaller envelope")
    used, index = np.unique(cells, return_inverse=True)
    return points[used], index.reshape(-1, 4)
