"""An interactive figure of the organ in three dimensions: its surface, the fluid in it, and the places."""

from __future__ import annotations

from html import escape
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
import scipy.sparse
from jaxtyping import Float, Int
from markupsafe import Markup
from scipy.sparse.csgraph import connected_components

from bayesreg.mesh import FACES, TetMesh
from bayesreg.report import style
from bayesreg.report.study import Study
from bayesreg.report.uncertainty import Place, places_of
from bayesreg.tissues import is_fluid

FLUID, PLACE = "#3a6ea5", "#e8891c"
# This grey is readable on white and on black.
TEXT = "#808b96"
# Factors by which the displacement is magnified.
ENLARGED = (0, 1, 2, 5)
SHOWN = {0: "before", 1: "after"}
LABEL = {"font": {"color": style.INK}, "bgcolor": "rgba(255,255,255,0.7)"}
FIGURE = Markup(
    '<figure id="figure-three-d"><h3>In three dimensions</h3>{}<figcaption>Drag to turn, scroll to come nearer. '
    "Surface of the mesh, fluid deep in it, and each place within the ellipsoid that holds it with 95 % (true size); "
    "the pose is left out. Right of “after” the displacement is enlarged.</figcaption></figure>"
)


class Surface(NamedTuple):
    """Triangles that move: points at rest and their displacement, (k, 3), mm, and indices into both, (t, 3)."""

    points: Float[np.ndarray, "k 3"]
    u: Float[np.ndarray, "k 3"]
    faces: Int[np.ndarray, "t 3"]

    def coordinates(self, enlargement: int) -> list[list[float]]:
        """Return the coordinates x, y and z with the displacement multiplied by `enlargement`."""
        return np.round(self.points + enlargement * self.u, 2).T.tolist()

    def drawn(self, **how: Any) -> go.Mesh3d:
        """Return the surface after the displacement."""
        corners = dict(zip("xyzijk", (*self.coordinates(1), *self.faces.T.tolist()), strict=True))
        return go.Mesh3d(**corners, flatshading=False, **how)


def three_d(study: Study) -> Markup:
    """Return an interactive figure with the program that draws it; it loads nothing from a network."""
    drawn = figure(study).to_html(full_html=False, include_plotlyjs=True, config={"displayModeBar": False})
    return FIGURE.format(Markup(drawn))


def figure(study: Study) -> go.Figure:
    """Draw the surface of the mesh, the places, and the fluid deep inside."""
    mesh, u = study.mesh, np.asarray(study.run.u_mean)
    places = places_of(study)
    surfaces = [_surface(mesh, u, mesh.boundary_faces), *(_ellipsoid(place) for place in places)]
    scales = _scales(study)
    traces = [surfaces[0].drawn(**scales["displacement"], opacity=0.35)]
    traces += [
        surface.drawn(color=PLACE, hoverinfo="name", name=escape(p.name))
        for surface, p in zip(surfaces[1:], places, strict=True)
    ]
    if len(fluid := _fluid_faces(mesh)):
        surfaces.append(_surface(mesh, u, fluid))
        traces.append(surfaces[-1].drawn(color=FLUID, hoverinfo="skip"))
    return go.Figure(traces, _layout(surfaces, scales, [_label(place) for place in places]))


def _scales(study: Study) -> dict[str, dict[str, Any]]:
    """Return the quantities that the colours of the surface can show, by name."""
    nodes = study.mesh.boundary
    length = np.linalg.norm(study.run.u_mean, axis=1)
    values = {
        "displacement": (length, style.MAGNITUDE, "|ū|, mm"),
        "95 % radius": (np.asarray(study.predicted.reach), style.ERROR, "95 % radius, mm"),
    }
    return {
        name: {
            "intensity": np.round(value[nodes], 3).tolist(),
            "colorscale": cmap.capitalize(),
            "cmin": 0.0,
            "cmax": float(np.quantile(value[nodes], 0.995)) or 1.0,
            "colorbar": {"title": {"text": title}, "thickness": 12, "len": 0.6},
            "hovertemplate": "%{intensity:.2f} mm<extra></extra>",
        }
        for name, (value, cmap, title) in values.items()
    }


def _layout(surfaces: list[Surface], scales: dict[str, dict[str, Any]], labels: list[dict[str, Any]]) -> dict[str, Any]:
    """Make the scene without a frame, a slider for the displacement, and buttons for the colours."""
    which = list(range(len(surfaces)))
    steps = [
        {
            "label": SHOWN.get(enlargement, f"× {enlargement}"),
            "method": "restyle",
            "args": [_moved(surfaces, enlargement), which],
        }
        for enlargement in ENLARGED
    ]
    buttons = [
        {"label": name, "method": "restyle", "args": [{key: [value] for key, value in scale.items()}, [0]]}
        for name, scale in scales.items()
    ]
    hidden = {"visible": False}
    return {
        "height": 600,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "font": {"color": TEXT},
        "showlegend": False,
        # World RAS: up is superior; seen from the front, right and above.
        "scene": {
            "aspectmode": "data",
            "annotations": labels,
            **{f"{axis}axis": hidden for axis in "xyz"},
            "camera": {"eye": {"x": 0.7, "y": 1.5, "z": 0.6}},
        },
        "sliders": [{"steps": steps, "active": 1, "x": 0.3, "len": 0.4, "y": 0.16, "currentvalue": {"visible": False}}],
        "updatemenus": [
            {"type": "buttons", "direction": "right", "buttons": buttons, "x": 0.0, "y": 0.99, "xanchor": "left"}
        ],
    }


def _moved(surfaces: list[Surface], enlargement: int) -> dict[str, list]:
    """Return the coordinates of all surfaces, as a change to the figure."""
    columns = zip(*(surface.coordinates(enlargement) for surface in surfaces), strict=True)
    return dict(zip("xyz", map(list, columns), strict=True))


def _surface(mesh: TetMesh, u: np.ndarray, faces: Int[np.ndarray, "t 3"]) -> Surface:
    nodes, index = np.unique(faces, return_inverse=True)
    return Surface(mesh.points[nodes], u[nodes], index.reshape(-1, 3))


def _ellipsoid(place: Place) -> Surface:
    """Draw the region of a place; it moves with the place."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 9), np.linspace(0, 2 * np.pi, 17)[:-1], indexing="ij")
    ball = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)
    quads = np.arange(8 * 16).reshape(8, 16)
    right = np.roll(quads, -1, axis=1)
    faces = np.concatenate([np.stack([quads, quads + 16, right], -1), np.stack([right, quads + 16, right + 16], -1)])
    region = place.region
    variance, axes = np.linalg.eigh(region.shape)
    points = place.point + (ball * np.sqrt(np.maximum(variance, 1e-4))) @ (axes * np.linalg.det(axes)).T
    return Surface(points, np.tile(region.mean, (len(points), 1)), faces.reshape(-1, 3))


def _label(place: Place) -> dict[str, Any]:
    """Draw the name of a place at its displaced place, in front of the scene."""
    position = dict(zip("xyz", (place.point + place.region.mean).tolist(), strict=True))
    return {**position, "text": escape(place.name), "showarrow": False, "xanchor": "left", "xshift": 6, **LABEL}


def _fluid_faces(mesh: TetMesh) -> Int[np.ndarray, "t 3"]:
    """Find the surface of the largest connected piece of fluid deep inside (the ventricles); empty without any."""
    fluid = np.array([is_fluid(name) for name in mesh.names])[mesh.tissue]
    deep = np.flatnonzero(fluid & ~np.isin(mesh.cells, mesh.boundary).any(axis=1))
    if not len(deep):
        return np.zeros((0, 3), int)
    cell, neighbour = mesh.neighbours[np.isin(mesh.neighbours, deep).all(axis=1)].T
    graph = scipy.sparse.coo_array((np.ones(len(cell)), (cell, neighbour)), (len(mesh.cells), len(mesh.cells)))
    piece = connected_components(graph, directed=False)[1][deep]
    largest = deep[piece == np.bincount(piece).argmax()]
    faces = mesh.cells[largest][:, FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]
