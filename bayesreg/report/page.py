"""Pages: sections with figures, tables and sentences, in one HTML file that needs no network."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from bayesreg import __version__
from bayesreg.io.atomic import write_text
from bayesreg.report.style import Drawing
from bayesreg.report.tables import Table
from bayesreg.report.verdict import Verdict


class Sentences(NamedTuple):
    """A list of sentences under a title (which may be empty)."""

    title: str
    sentences: Sequence[str]
    kind: str = "sentences"


Item = Drawing | Table | Sentences | Markup


class PageSection(NamedTuple):
    """A section of a page as it is shown."""

    title: str
    items: Sequence[Item]

    @property
    def anchor(self) -> str:
        """The name of the section in a link."""
        return self.title.lower().replace(" ", "-")


class Opening(NamedTuple):
    """The first part of a page.

    Attributes
    ----------
    kicker, title, lead : str
        The kind of the page, its title, and a line below it.
    verdicts : list of (str, Verdict)
        One for each run, under its name (which may be empty).
    answers : list of (str, str)
        Questions and answers.
    approximation : str
        A warning that the draws are not from the exact posterior; empty if they are.
    warnings : list of str
    """

    kicker: str
    title: str
    lead: str = ""
    verdicts: Sequence[tuple[str, Verdict]] = ()
    answers: Sequence[tuple[str, str]] = ()
    approximation: str = ""
    warnings: Sequence[str] = ()


def write_page(path: str | Path, opening: Opening, sections: Iterable[PageSection]) -> None:
    """Write a page; sections without content are left out."""
    shown = [section for section in sections if section.items]
    write_text(path, render("page.html", {**opening._asdict(), "sections": shown}))


def render(template: str, content: Mapping[str, Any]) -> str:
    """Fill a template; all text is escaped."""
    environment = Environment(
        loader=PackageLoader("bayesreg", "report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters["indexed"] = _index
    style = Markup(files("bayesreg.report").joinpath("style.css").read_text(encoding="utf-8"))
    return environment.get_template(template).render(version=__version__, style=style, **content)


def _index(text: str) -> Markup:
    """Escape text, and set u_x, T_s and similar symbols with a subscript."""
    return Markup(re.sub(r"\b([uTE])_([xyzrs])\b", r"\1<sub>\2</sub>", str(escape(text))))
