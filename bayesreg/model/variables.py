"""The presentation of draws to a reader: names, dimensions and labels, known entries included."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from bayesreg.mesh import TetMesh
from bayesreg.model.blocks import LAME, Blocks, Values
from bayesreg.model.coordinates import sampled_blocks
from bayesreg.types import AnyArray

DIMS = {
    "u_boundary": ("node", "axis"),
    "lam": ("tissue",),
    "mu": ("tissue",),
    "ratio": ("tissue",),
    "field": ("mode",),
    "points": ("point", "axis"),
    "cells": ("cell", "corner"),
    "tissue": ("cell",),
    "boundary": ("node",),
}

# "1" is a number without unit: moduli are relative, unless one of them is fixed in a unit.
MEANINGS = {
    "u_boundary": ("displacement of the sampled nodes, world RAS", "mm"),
    "lam": ("first Lamé parameter λ", "1"),
    "mu": ("second Lamé parameter μ, the shear modulus", "1"),
    "ratio": ("λ/μ", "1"),
    "field": ("components of the logarithm of stiffness, whitened", "1"),
    "field_sd": ("standard deviation of the logarithm of stiffness", "1"),
    "t_similarity": ("temperature T_s of the images", "1"),
    "t_elastic": ("temperature T_r of the elastic prior", "1"),
    "body_load": ("standard deviation of the random loads inside, over the root of volume", "1"),
    "surface_load": ("standard deviation of the random loads at the surface, over the root of area", "1"),
    "points": ("nodes, world RAS", "mm"),
    "cells": ("nodes of each tetrahedron", "1"),
    "tissue": ("tissue of each tetrahedron", "1"),
    "boundary": ("sampled nodes", "1"),
}


@dataclass(frozen=True, eq=False)
class Variables:
    """Names and labels as in xarray (`bayesreg.inference.target.Variables`).

    Attributes
    ----------
    blocks : dict
    mesh : TetMesh
    nodes : (b,) int array
        The sampled nodes.
    entry_names : sequence of str
        The names of the entries of λ and μ.
    """

    blocks: Blocks
    mesh: TetMesh
    nodes: Int[np.ndarray, "sampled"]
    entry_names: Sequence[str]

    @property
    def dims(self) -> Mapping[str, Sequence[str]]:
        """The dimensions of each variable and constant, without chain and draw."""
        return DIMS

    @property
    def coords(self) -> dict[str, Any]:
        """The labels along "node", "axis" and "tissue"."""
        return {"node": np.asarray(self.nodes), "axis": list("xyz"), "tissue": list(self.entry_names)}

    @property
    def constants(self) -> dict[str, AnyArray]:
        """Points (mm), cells, tissue of every cell and the sampled nodes."""
        mesh = self.mesh
        return {"points": mesh.points, "cells": mesh.cells, "tissue": mesh.tissue, "boundary": self.nodes}

    @property
    def attributes(self) -> Mapping[str, Mapping[str, str]]:
        """The meaning and the units of variables and constants."""
        return {name: {"long_name": meaning, "units": units} for name, (meaning, units) in MEANINGS.items()}

    def values(self, estimands: Values) -> dict[str, np.ndarray]:
        """Return u_B, all entries of λ, μ and λ/μ, and all other sampled values; arrays may have leading axes.

        NumPy computes them on the host because there may be many draws.
        """
        values = {"u_boundary": np.asarray(estimands["u_boundary"])}
        leading = values["u_boundary"].shape[:-2]
        for name in LAME:
            block = self.blocks[name]
            values[name] = np.tile(np.asarray(block.reference()), (*leading, 1))
            if block.is_sampled:
                values[name][..., block.free.index] = estimands[name]
        with np.errstate(divide="ignore", invalid="ignore"):
            values["ratio"] = values["lam"] / values["mu"]
        others = (name for name in self.blocks if name in estimands and name not in values)
        return values | {name: np.asarray(estimands[name]) for name in others}

    def estimands(self, values: Values) -> dict[str, np.ndarray]:
        """Return the sampled entries of values that `values` made."""
        estimands = {}
        for name, block in sampled_blocks(self.blocks).items():
            value = np.asarray(values[name])
            estimands[name] = value[..., block.free.index] if name in LAME else value
        return estimands
