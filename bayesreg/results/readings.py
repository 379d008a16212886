"""Other readings of points to transform: those of the other image, in voxel indices, or in the other of LPS and RAS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from bayesreg.image import Image
from bayesreg.model.observations.odd_points import Reading, lie_near, other_readings, suspect_reading
from bayesreg.results.result import Result
from bayesreg.results.transform import Transform


def own_grids(result: Result, side: Literal["fixed", "moving"]) -> dict[str, Image]:
    """Return the grid whose voxel indices may have been given for points, by its name; none without an image."""
    run = result.run
    if side == "fixed":
        return {"the labels": run.tissue} if run.fixed is None else {"the fixed image": run.fixed}
    return {} if run.moving is None else {"the moving image": run.matching.pose.inverse.aligned(run.moving)}


def suspect_other_reading(points: Float[np.ndarray, "k 3"], grids: Mapping[str, Image], transform: Transform) -> str:
    """Say by which other reading clearly more points would lie in the organ or near it; empty if by none."""
    rest = transform.mesh
    moved = replace(rest, points=transform.pose.place(rest.points + transform.u_mean))
    if transform.turned:
        here, there, image, remedy = moved, rest, "fixed", "leave --inverse out"
    else:
        here, there, image, remedy = rest, moved, "moving", "give --inverse"
    near = lie_near(here, points)
    if near.all():
        return ""
    of_other = Reading(f"points of the {image} image", remedy, there, points)
    return suspect_reading(near, [*other_readings(here, points, grids), of_other])
