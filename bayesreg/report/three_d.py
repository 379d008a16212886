"""The organ in three dimensions, drawn by the browser: three.js stands in the page, which loads nothing."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from markupsafe import Markup
from scipy.sparse.csgraph import connected_components

from bayesreg.io.records import Predicted
from bayesreg.mesh import FACES, TetMesh
from bayesreg.report import style
from bayesreg.report.panels import View
from bayesreg.report.uncertainty import region
from bayesreg.tissues import is_fluid

# Of the triangles' points, mm, and of colours.
DECIMALS = 2
FLUID = "#3a6ea5"


class Scale(NamedTuple):
    """What colours mean."""

    name: str
    label: str
    greatest: str
    gradient: str


class ThreeD(NamedTuple):
    """What the page needs.

    Attributes
    ----------
    data : Markup
        JSON.
    libraries : dict
        Name in the import map to a data URI.
    program : Markup
        The module that draws.
    scales : list of Scale
    caption : str
    """

    data: Markup
    libraries: dict[str, str]
    program: Markup
    scales: list[Scale]
    caption: str


def three_d(view: View, predicted: Predicted) -> ThreeD:
    """The surface of the organ, the fluid in it, and the regions that hold places with 95 %."""
    mesh, u = view.run.mesh, np.asarray(view.run.u_mean)
    values = {"displacement": np.linalg.norm(u, axis=1), "uncertainty": np.asarray(predicted.reach)}
    labels = {"displacement": "displacement, mm", "uncertainty": "95 % radius, mm"}
    outer, scales, colours = mesh.boundary_faces, [], {}
    for name, value in values.items():
        greatest = float(np.quantile(value[mesh.boundary], 0.995)) or 1.0
        cmap = mpl.colormaps[style.MAGNITUDE if name == "displacement" else style.ERROR]
        # Linear light, as the renderer has it.
        colours[name] = cmap(np.clip(value / greatest, 0, 1))[:, :3] ** 2.2
        stops = ", ".join(mpl.colors.to_hex(cmap(x)) for x in np.linspace(0, 1, 9))
        scales.append(Scale(name, labels[name], f"{greatest:.2g}", f"linear-gradient(to right, {stops})"))
    shells = [_shell(mesh, u, outer, colours)]
    inner = _fluid_surface(mesh)
    if len(inner):
        shells.append(_shell(mesh, u, inner, None))
    content = {
        "centre": _rounded(mesh.points.mean(axis=0)),
        "size": float(np.ptp(mesh.points, axis=0).max()),
        "shells": shells,
        "places": _places(predicted),
    }
    caption = (
        "Drag to turn, scroll to come nearer. The surface of the mesh and the fluid deep in it, where they were before "
        "and where the posterior mean takes them (the pose left out), and each place within the ellipsoid that holds "
        "it with 95 %. “Enlarge” shows movement and ellipsoids so many times as large as they are."
    )
    own = {"three": "three.module.min.js", "orbit-controls": "OrbitControls.js"}
    libraries = {name: _data_uri(_read(file)) for name, file in own.items()}
    return ThreeD(_embedded(content), libraries, Markup(_read("view.js")), scales, caption)


def _shell(
    mesh: TetMesh, u: Float[np.ndarray, "nodes 3"], faces: Int[np.ndarray, "t 3"], colours: dict[str, Any] | None
) -> dict[str, Any]:
    """A surface with points of its own."""
    nodes, index = np.unique(faces, return_inverse=True)
    return {
        "points": _rounded(mesh.points[nodes]),
        "moved": _rounded(u[nodes]),
        "faces": index.reshape(-1, 3).tolist(),
        "colours": colours and {name: _rounded(colour[nodes].ravel()) for name, colour in colours.items()},
        "colour": FLUID,
    }


def _fluid_surface(mesh: TetMesh) -> Int[np.ndarray, "t 3"]:
    """The surface of the largest connected piece of fluid deep inside, such as the ventricles; empty without any."""
    fluid = np.array([is_fluid(name) for name in mesh.names])[mesh.tissue]
    deep = np.flatnonzero(fluid & ~np.isin(mesh.cells, mesh.boundary).any(axis=1))
    if not len(deep):
        return np.zeros((0, 3), int)
    one, other = mesh.neighbours[np.isin(mesh.neighbours, deep).all(axis=1)].T
    graph = scipy.sparse.coo_array((np.ones(len(one)), (one, other)), (len(mesh.cells), len(mesh.cells)))
    piece = connected_components(graph, directed=False)[1][deep]
    largest = deep[piece == np.bincount(piece).argmax()]
    faces = mesh.cells[largest][:, FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]


def _places(predicted: Predicted) -> list[dict[str, Any]]:
    draws = np.asarray(predicted.place_draws)
    found = []
    for index, (name, point) in enumerate(zip(predicted.place_names, predicted.place_points, strict=True)):
        here = draws[:, :, index].reshape(-1, 3)
        variance, directions = np.linalg.eigh(region(here).shape)
        axes = directions.T * np.sign(np.linalg.det(directions))
        found.append(
            {
                "name": str(name),
                "point": _rounded(point),
                "moved": _rounded(here.mean(axis=0)),
                "half": np.round(np.sqrt(np.maximum(variance, 1e-4)), 3).tolist(),
                "axes": np.round(axes, 4).tolist(),
            }
        )
    return found


def _rounded(values: Any) -> Any:
    return np.round(np.asarray(values, float), DECIMALS).tolist()


def _embedded(content: Any) -> Markup:
    """JSON that ends no script element, whatever a place is called."""
    return Markup(json.dumps(content, separators=(",", ":")).replace("<", "\\u003c"))


def _read(name: str) -> str:
    return files("bayesreg.report").joinpath("viewer", name).read_text(encoding="utf-8")


def _data_uri(program: str) -> str:
    return f"data:text/javascript;base64,{base64.b64encode(program.encode()).decode('ascii')}"
