"""Colours, fonts and embedding: one style for all figures."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

INK = "#1f2933"
MUTED = "#66727f"
FAINT = "#cbd2d9"
ACCENT = "#9b2335"
TRUTH = "#111111"

SKULL = "#39424e"
# Colour of borders on grey images.
BORDER = "#f5b83d"
UNIFORM = "#5b6b7b"

MAGNITUDE = "viridis"
ERROR = "magma"
SIGNED = "RdBu_r"
GREY = "gray"

WIDTH = 10.8
DPI = 160
# Quality of pictures, from 1 to 100.
QUALITY = 88

_SETTINGS: Any = {
    "font.family": "sans-serif",
    "font.size": 8.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.linewidth": 0.7,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titlepad": 5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "xtick.major.size": 3,
    "ytick.major.size": 3,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.facecolor": "white",
    "figure.constrained_layout.h_pad": 0.06,
    "svg.fonttype": "path",
    "svg.hashsalt": "bayesreg",
}


class Drawing(NamedTuple):
    """A figure of the report.

    Attributes
    ----------
    key : str
        The anchor of the figure.
    title : str
    caption : str
    alt : str
        A description for readers who cannot see the figure.
    uri : str
        The picture itself, a data URI.
    """

    key: str
    title: str
    caption: str
    alt: str
    uri: str
    kind: str = "figure"


@contextmanager
def look() -> Iterator[None]:
    """Apply the common style inside this block."""
    with mpl.rc_context(_SETTINGS):
        yield


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """Make a figure with the width of the page, inches."""
    return Figure(figsize=(width, height), layout=ConstrainedLayoutEngine(hspace=0.04))


def data_uri(figure: Figure, kind: str = "webp") -> str:
    """Encode a figure as a data URI: "webp" for pictures (a fifth of the size of PNG), "svg" for curves."""
    buffer = io.BytesIO()
    if kind == "svg":
        figure.savefig(buffer, format=kind, metadata={"Date": None})
    else:
        figure.savefig(buffer, format=kind, dpi=DPI, pil_kwargs={"quality": QUALITY})
    media = "image/svg+xml" if kind == "svg" else f"image/{kind}"
    return f"data:{media};base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def literal(text: str) -> str:
    """Escape a user's text so that Matplotlib does not format it as a formula."""
    return text.replace("$", r"\$")


def chain_colours(count: int) -> list[str]:
    """Return a colour for each chain."""
    if count <= len(_FEW_CHAINS):
        return list(_FEW_CHAINS[:count])
    colours = mpl.colormaps["viridis"].resampled(count)
    return [mpl.colors.to_hex(colours(index)) for index in range(count)]


_FEW_CHAINS = ("#2b5c8a", "#d08c3f", "#4f9d86", "#a84a63")
