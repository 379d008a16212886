"""Define the properties of tissues by their names: presets for brains, and defaults for all other names.

Only this module, the datasets (`bayesreg.io.datasets`) and the label tables (`bayesreg.label_tables`) name tissues.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple


class Tissue(NamedTuple):
    """The properties of a tissue.

    Attributes
    ----------
    label : str
        The name of the tissue in reports.
    colour : str
        The colour of the tissue in figures.
    is_fluid : bool
        Whether the tissue has almost no stiffness. A fluid fills the space that other tissues leave; its stiffness is
        not of interest.
    has_unit_mu : bool
        Whether the default fixes the μ of this tissue at 1.
    """

    label: str
    colour: str
    is_fluid: bool = False
    has_unit_mu: bool = False


class Stiffness(NamedTuple):
    """The usual stiffness of a tissue. The medians of its default priors follow from it.

    Attributes
    ----------
    mu : float
        μ relative to that of most solid tissue.
    ratio : float
        λ/μ, which is 2ν / (1 − 2ν) for a Poisson's ratio ν.
    """

    mu: float = 1.0
    ratio: float = 12.0


# The presets by name, in small letters. The colours differ in hue and in lightness, so that colour-blind readers and
# grey prints distinguish them.
PRESETS: Mapping[str, Tissue] = {
    "csf": Tissue("CSF", "#3a6ea5", is_fluid=True),
    "gm": Tissue("GM", "#c26a6f", has_unit_mu=True),
    "wm": Tissue("WM", "#e3b95a"),
    "fluid": Tissue("fluid", "#6f9fc8", is_fluid=True),
}
COLOURS = ("#5c9a86", "#7d6aa8", "#b07c46", "#8aa34f", "#a3597f", "#4f8fa3")

# The tissues of brains in the datasets, in the order of the paper, and the paper's true values.
BRAIN = ("csf", "gm", "wm")
PAPER_LAM: Mapping[str, float] = dict(zip(BRAIN, (1e-6, 10.0, 30.0), strict=True))
PAPER_MU: Mapping[str, float] = dict(zip(BRAIN, (1e-6, 1.0, 1.0), strict=True))

# Default lengths for a human brain, mm: the edges on the boundary of its mesh, the radius of the closing that makes its
# hull, and the gap between mesh and skull.
BRAIN_EDGE, BRAIN_CLOSING, BRAIN_GAP = 15.5, 8.0, 0.5

# The volume of solid tissue in Colin27, mm³. The lengths for other organs are proportional to their size.
BRAIN_VOLUME = 1.583e6

# The λ and μ of a solid at the start (the literature's λ/μ is about 24), and the value of both for a fluid, if their
# priors have no median.
SOLID = {"lam": 10.0, "mu": 1.0}
FLUID = 0.01

# The usual stiffness by a word in the name of the tissue; all other tissues have that of a solid. The literature for
# each is in docs/model.md, "Priors of stiffness". A fluid stands for what leaves its place, and so does the air of a
# lung: both change their volume easily.
STIFFNESS: Mapping[str, Stiffness] = {
    **dict.fromkeys(("csf", "fluid"), Stiffness(mu=0.05, ratio=1.0)),
    **dict.fromkeys(("lung", "lungs"), Stiffness(ratio=1.0)),
    **dict.fromkeys(("tumour", "tumor", "lesion", "enhancing"), Stiffness(mu=1.5)),
}
# The standard deviations of log μ and of log(λ/μ) in the default priors. A solid has its Poisson's ratio in
# [0.3, 0.495] with a probability of 98 %.
MU_LOG_SD, RATIO_LOG_SD = 0.7, 0.9

# The name in a label table of everything outside the organ.
BACKGROUND = "background"
# The name of the only tissue of an organ without labels.
ORGAN = "organ"


def is_fluid(name: str) -> bool:
    """Report whether a tissue of this name is a fluid, which has almost no stiffness."""
    return name.lower() in PRESETS and PRESETS[name.lower()].is_fluid


def label_of(name: str) -> str:
    """Return the name of a tissue in reports, or of all of them together where they have one stiffness ("uniform")."""
    if name == "uniform":
        return "the whole organ"
    preset = PRESETS.get(name.lower())
    return preset.label if preset else name


def colours_of(names: Sequence[str]) -> list[str]:
    """Choose a colour for each tissue; the colours are the same in every figure."""
    others = itertools.cycle(COLOURS)
    return [PRESETS[name.lower()].colour if name.lower() in PRESETS else next(others) for name in names]


def tissue_of_unit_mu(names: Sequence[str]) -> str:
    """Return the tissue whose μ is fixed at 1 by default: the tissue of the preset, else the first solid tissue."""
    preset = (name for name in names if name.lower() in PRESETS and PRESETS[name.lower()].has_unit_mu)
    return next(preset, next((name for name in names if not is_fluid(name)), names[0]))


def usual_stiffness(name: str) -> Stiffness:
    """Return the usual stiffness of a tissue by the first word of its name that tells it; else that of a solid."""
    return next((STIFFNESS[word] for word in name.lower().split("_") if word in STIFFNESS), Stiffness())


def usual_value(parameter: str, name: str) -> float:
    """Return the λ ("lam") or μ ("mu") of a tissue at the start, if its prior has no median."""
    return FLUID if is_fluid(name) else SOLID[parameter]


def tissue_names(table: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the tissues in a label table, in its order, without the background."""
    return tuple(name for name in table if name != BACKGROUND)
