"""The base of every kind of observation in a configuration: section of the YAML, reader, and part of the report."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from pydantic import AfterValidator

from bayesreg.io.records import Inputs
from bayesreg.model.options import is_reserved_name
from bayesreg.settings import Section

Arrays = Mapping[str, np.ndarray]


class ReportTable(NamedTuple):
    """A table that a kind of observation adds to the report.

    Attributes
    ----------
    title, caption : str
    header : list of str
        The first entry heads the names of the rows.
    rows : list of lists
        Each entry is text, a number, which the report rounds, or None, which it shows as missing.
    places : (rows, 3) array or None
        World RAS mm in the fixed image: the report describes the place of each row.
    """

    title: str
    caption: str
    header: list[str]
    rows: list[list[Any]]
    places: np.ndarray | None = None


class ReportFigure(NamedTuple):
    """A figure that a kind of observation adds to the report.

    Attributes
    ----------
    name, title, caption, alt : str
    height : float
        Inches.
    draw : callable
        (Matplotlib figure, style) → None; the style has the colours of the report (`bayesreg.report.style`).
    """

    name: str
    title: str
    caption: str
    alt: str
    height: float
    draw: Any


def _require_free(name: str) -> str:
    if not name.isidentifier():
        raise ValueError("expected a name of letters, digits and _, such as left_lobe")
    if is_reserved_name(name):
        raise ValueError("this name is taken; expected another one")
    return name


Name = Annotated[str, AfterValidator(_require_free)]


class ObservationSection(Section):
    """The base of the entries of the list `observations`: a subclass for each kind, with `kind: Literal["…"]`.

    Another package registers its kind by `bayesreg.model.observations.registry.register`, or by an entry point of the
    group "bayesreg.observations".
    """

    # The name of the kind in the report.
    title: ClassVar[str] = "an observation of your own"

    kind: str
    name: Name
    """The name of the observation in tables; two observations need two."""

    def read(self) -> dict[str, np.ndarray]:
        """Read the files that the section names, before any long computation; the run folder stores the arrays."""
        return {}

    @abstractmethod
    def observe(self, inputs: Inputs) -> Sequence[Any]:
        """Make the observations from the arrays `inputs.observed[self.name]` and from all other inputs of the run."""

    # For the report: `summary` holds the arrays of the observation's method `summarise`, and those of `check_draw`
    # (chain, draw, …); `described` is the observation's entry in run.json.

    @classmethod
    def log_density(cls, name: str) -> str:
        """Return the term of the log density in HTML, with its sign."""
        return f" + log p({name} | <var>u</var>)"

    @classmethod
    def explain(cls, name: str, described: Mapping[str, Any]) -> str:
        """Return a sentence in HTML that explains the term; empty if its name is enough."""
        return ""

    @classmethod
    def tables(cls, name: str, summary: Arrays) -> list[ReportTable]:
        """Return the tables of an observation of this name."""
        return []

    @classmethod
    def figures(
        cls, name: str, summary: Arrays, tissues: Sequence[str], described: Mapping[str, Any]
    ) -> list[ReportFigure]:
        """Return the figures of an observation of this name; `tissues` are the tissues of the mesh."""
        return []
