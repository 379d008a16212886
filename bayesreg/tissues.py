"""Facts about tissues that a name tells: the presets of brains, and neutral ones of all other names.

Besides the datasets (`bayesreg.io.datasets`) and label tables (`bayesreg.label_tables`) the only place where tissues
are named.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple


class Tissue(NamedTuple):
    """Facts about a tissue.

    Attributes
    ----------
    label : str
        Its name for people.
    colour : str
        In figures.
    is_fluid : bool
        Whether it hardly resists: it starts at λ = μ = 0.01, fills the space that others leave, and its stiffness is
        not worth looking for.
    has_unit_mu : bool
        Whether its μ is the one that is fixed at 1 where nothing else is said.
    """

    label: str
    colour: str
    is_fluid: bool = False
    has_unit_mu: bool = False


# By name in small letters. Colours are distinct in hue and in lightness, also for colour-blind eyes and in grey.
PRESETS: Mapping[str, Tissue] = {
    "csf": Tissue("CSF", "#3a6ea5", is_fluid=True),
    "gm": Tissue("GM", "#c26a6f", has_unit_mu=True),
    "wm": Tissue("WM", "#e3b95a"),
    "fluid": Tissue("fluid", "#6f9fc8", is_fluid=True),
}
COLOURS = ("#5c9a86", "#7d6aa8", "#b07c46", "#8aa34f", "#a3597f", "#4f8fa3")

# The tissues of the brains that the package ships or reads, in the order of the paper, and the paper's true values.
BRAIN = ("csf", "gm", "wm")
PAPER_LAM: Mapping[str, float] = dict(zip(BRAIN, (1e-6, 10.0, 30.0), strict=True))
PAPER_MU: Mapping[str, float] = dict(zip(BRAIN, (1e-6, 1.0, 1.0), strict=True))

# Lengths that suit a human brain, mm: of an edge on the boundary of its mesh, the radius of the closing that makes its
# hull, and the gap between mesh and skull.
BRAIN_EDGE, BRAIN_CLOSING, BRAIN_GAP = 15.5, 8.0, 0.5

# Solid tissue of Colin27, mm³: lengths that suit a brain of this size suit others in proportion.
BRAIN_VOLUME = 1.583e6

# λ and μ where nothing is said (the literature's λ/μ is about 24), and those of a fluid.
SOLID = {"lam": 10.0, "mu": 1.0}
FLUID = 0.01
# In a label table, what is no part of the organ.
BACKGROUND = "background"
# The one tissue of an organ without labels.
ORGAN = "organ"


def is_fluid(name: str) -> bool:
    """Whether a tissue of this name hardly resists."""
    return name.lower() in PRESETS and PRESETS[name.lower()].is_fluid


def label_of(name: str) -> str:
    """A tissue's name for people."""
    preset = PRESETS.get(name.lower())
    return preset.label if preset else name


def colours_of(names: Sequence[str]) -> list[str]:
    """A colour for each tissue, the same in every figure."""
    others = itertools.cycle(COLOURS)
    return [PRESETS[name.lower()].colour if name.lower() in PRESETS else next(others) for name in names]


def tissue_of_unit_mu(names: Sequence[str]) -> str:
    """The tissue whose μ is 1 where nothing else is said: the preset's, else the first that is no fluid."""
    preset = (name for name in names if name.lower() in PRESETS and PRESETS[name.lower()].has_unit_mu)
    return next(preset, next((name for name in names if not is_fluid(name)), names[0]))


def usual_value(parameter: str, name: str) -> float:
    """λ ("lam") or μ ("mu") of a tissue where nothing is said."""
    return FLUID if is_fluid(name) else SOLID[parameter]


def tissue_names(table: Iterable[str]) -> tuple[str, ...]:
    """The names of a label table that are those of tissues, in its order."""
    return tuple(name for name in table if name != BACKGROUND)
