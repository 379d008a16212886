"""The kinds of observations that a configuration may list."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
from typing import Annotated, Any, get_args

from pydantic import AfterValidator, BeforeValidator, SerializeAsAny

from bayesreg.model.observations.images.section import ImagesSection
from bayesreg.model.observations.landmarks_section import LandmarksSection
from bayesreg.model.observations.section import ObservationSection
from bayesreg.model.observations.surface import SurfaceSection

GROUP = "bayesreg.observations"
_registered: dict[str, type[ObservationSection]] = {}


def register(section: type[ObservationSection]) -> type[ObservationSection]:
    """Register a kind of observation, given by its section of a configuration; may be used as a decorator.

    Raises
    ------
    ValueError
        If another class has the same kind.
    """
    (kind,) = get_args(section.model_fields["kind"].annotation)
    if _registered.get(kind, section) is not section:
        raise ValueError(f"the kind of observation {kind!r} is {_registered[kind].__name__}'s already")
    _registered[kind] = section
    return section


for _section in (ImagesSection, LandmarksSection, SurfaceSection):
    register(_section)


def kinds() -> Mapping[str, type[ObservationSection]]:
    """Return every kind by its name, including those of installed packages."""
    _load_entry_points()
    return _registered


@cache
def _load_entry_points() -> None:
    for point in entry_points(group=GROUP):
        register(point.load())


def _as_section(value: object, info: Any) -> ObservationSection:
    """Convert an entry of the list `observations` to the section of its kind."""
    if isinstance(value, ObservationSection):
        return value
    if not isinstance(value, Mapping):
        raise ValueError("expected keys with values, such as kind: landmarks")
    listed = ", ".join(kinds())
    if "kind" not in value:
        raise ValueError(f"the kind is missing; expected one of {listed}")
    if value["kind"] not in kinds():
        raise ValueError(f"there is no kind of observation {value['kind']!r:.60}; expected one of {listed}")
    return kinds()[value["kind"]].model_validate(value, context=info.context)


def _require_different_names(sections: list[Any]) -> list[Any]:
    names = [section.name for section in sections]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two observations are named {name}; give one of them another name")
    return sections


AnyObservation = Annotated[SerializeAsAny[ObservationSection], BeforeValidator(_as_section)]
Observations = Annotated[list[AnyObservation], AfterValidator(_require_different_names)]
