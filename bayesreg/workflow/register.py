"""Make the configuration of a pair from the paths of its files, and describe it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayesreg.config import Config, make_config, read_mapping
from bayesreg.config.data import FilesData
from bayesreg.io.grids import Grid
from bayesreg.io.readers import read_grid
from bayesreg.io.volumes import load_whole_numbers, shorten
from bayesreg.label_tables import TABLES, recognise_tables
from bayesreg.model.observations.landmarks_section import LandmarksSection
from bayesreg.model.observations.surface import SurfaceSection
from bayesreg.tissues import ORGAN
from bayesreg.types import InputError

# These draws are independent, so that few are enough.
QUICK = {"sampler": {"name": "laplace"}, "stop": {"rhat": None, "ess": None, "max_steps": 100}}
# The sd of each rigid motion, mm, where points on a surface are all that is observed: that of a navigated scan, and
# that of a pose which the points themselves tell.
RIGID_SD, RIGID_SD_OF_FOUND = 1.0, 10.0


class Understood(NamedTuple):
    """A configuration that was made from paths, with its description.

    Attributes
    ----------
    config : Config
    lines : tuple of str
        A description of grids, labels, mask and choices, which the user can read before the long steps begin.
    """

    config: Config
    lines: tuple[str, ...]


def understand(
    fixed: Path | None = None,
    moving: Path | None = None,
    labels: Path | None = None,
    table: str | None = None,
    intracranial: Path | None = None,
    fixed_ignore: Path | None = None,
    moving_ignore: Path | None = None,
    channels: Sequence[str] = (),
    overrides: Sequence[str] = (),
    quick: bool = False,
    landmarks: Sequence[Path] = (),
    surfaces: Sequence[Path] = (),
) -> Understood:
    """Make the configuration of a pair in files.

    Parameters
    ----------
    fixed, moving : path, optional
        Two images; none where points or a surface are all that is observed.
    labels : path, optional
        Tissue labels of the fixed image, or a mask of the organ. Without them, the organ is `intracranial`, or what
        both images show of the bright part of the fixed one.
    table : str, optional
        The name of a label table (`bayesreg.label_tables`), or a YAML file with labels by tissue. The default is
        recognised from the values of the labels.
    intracranial : path, optional
        Mask of where the organ may go.
    fixed_ignore, moving_ignore : path, optional
        Masks of the ignored part of the fixed and the moving image; not zero = ignored.
    channels : sequence of str
        Further images of the same two visits: the paths of a fixed and a moving image, with a comma between them.
    overrides : sequence of str
        As in `bayesreg.load_config`.
    quick : bool
        Whether the run ends at draws from Laplace's approximation.
    landmarks : sequence of path
        Pairs of points that show the same places.
    surfaces : sequence of path
        Points on the moved surface of the organ, without partners. Where nothing else is observed, the rigid motion
        has a prior of sd `RIGID_SD`, since a part of a surface says little about it; of `RIGID_SD_OF_FOUND` with
        data.pose=unknown.

    Raises
    ------
    InputError
        If a file is missing or unreadable, nothing is observed, one image is given alone, no table fits the labels, or
        an override is wrong.
    """
    if (fixed is None) != (moving is None):
        raise InputError(f"{fixed or moving} is one image; give FIXED and MOVING, or no image")
    if fixed is None and not landmarks and not surfaces:
        raise InputError("nothing is observed; give two images, --landmarks or --surface")
    if fixed is None and labels is None:
        raise InputError("without images, --labels says where the organ is: a mask, or labels of its tissues")
    if labels is None and table is not None:
        raise InputError(f"--table {table} says what labels mean; give --labels, too")
    chosen, how = (None, "none") if labels is None else _choose_table(labels, table)
    paths = {
        "fixed": fixed, "moving": moving, "labels": labels, "intracranial": intracranial,
        "fixed_ignore": fixed_ignore, "moving_ignore": moving_ignore,
    }  # fmt: skip
    files = {name: str(path.absolute()) for name, path in paths.items() if path is not None}
    sections: dict[str, Any] = {"data": {"source": "files", "label_table": chosen, **files}}
    pair = [] if fixed is None else [{"kind": "images"}]
    sections["observations"] = [
        *pair,
        *(_channel(k, paths) for k, paths in enumerate(channels, 2)),
        *_of_files("landmarks", landmarks),
        *_of_files("surface", surfaces),
    ]
    if fixed is None:
        # Points and surfaces hardly tell tissues apart, and one stiffness takes a tenth of the time.
        sections["model"] = {"elasticity": "uniform", **({} if landmarks else {"rigid_sd": RIGID_SD})}
    if quick:
        sections |= QUICK
    config = make_config(sections, overrides)
    if fixed is None and isinstance(config.data, FilesData) and config.data.pose == "unknown" and not landmarks:
        sections["model"]["rigid_sd"] = RIGID_SD_OF_FOUND
        config = make_config(sections, overrides)
    if any(override.startswith("data.label_table") for override in overrides):
        how = "as set"
    return Understood(config, tuple(_describe(config, how)))


def _of_files(kind: str, paths: Sequence[Path]) -> list[dict[str, str]]:
    """Make an observation of a kind for each file; each has a name of its own."""
    return [
        {"kind": kind, "file": str(path.absolute()), "name": kind if number == 1 else f"{kind}_{number}"}
        for number, path in enumerate(paths, 1)
    ]


def _describe(config: Config, how: str) -> Iterator[str]:
    """Describe the files and choices of a configuration, one line each; `how` is the source of its label table."""
    data = config.data
    assert isinstance(data, FilesData)
    for name in ("fixed", "moving", "labels"):
        if (path := getattr(data, name)) is not None:
            yield f"{name:<12}{path}: {_describe_grid(read_grid(path))}"
    if data.labels is None:
        yield f"{'labels':<12}none: the organ is {_describe_organ(data)}, of one tissue"
    else:
        tissues = "; ".join(f"{name} {shorten(values, 12)}" for name, values in (data.label_table or {}).items())
        yield f"{'table':<12}{how}: {tissues}"
    yield f"{'mask':<12}{data.intracranial or 'none: nothing bounds the motion'}"
    for section in config.observations:
        if isinstance(section, LandmarksSection | SurfaceSection):
            yield f"{section.name:<12}{section.file}"
    for section in config.pairs_of_images:
        if section.fixed is not None:
            yield f"{section.name:<12}{section.fixed} and {section.moving}, compared as well"
    for image in ("fixed", "moving"):
        if (path := getattr(data, f"{image}_ignore")) is not None:
            yield f"{'ignored':<12}what is not zero in {path} says nothing, in the {image} image"
    if data.fixed is not None:
        pose = "as the headers say" if data.pose == "fixed" else "looked for where the headers do not fit"
        yield f"{'pose':<12}{pose}"
        contrast = {None: "found out", True: "one, on one scale of intensities", False: "unlike"}[data.same_contrast]
        yield f"{'contrast':<12}{contrast}; compared by {config.image_options.similarity.kind}"
    yield f"{'model':<12}preset {config.model.preset}"
    if config.model.elasticity == "uniform" and len(getattr(data, "label_table", None) or ()) > 1:
        yield f"{'stiffness':<12}one for all tissues; each its own: --set model.elasticity=tissue"
    if config.model.rigid_sd is not None:
        pose = "looked for by the surface" if data.pose == "unknown" else "as the headers say"
        yield f"{'pose':<12}{pose}, each rigid motion to {config.model.rigid_sd:g} mm (model.rigid_sd)"
    if config.sampler.name == "laplace":
        yield f"{'sampler':<12}laplace, approximate: independent draws of the Gaussian about the mode"


def _channel(number: int, pair: str) -> dict[str, str]:
    pieces = pair.split(",")
    # A path may also contain a comma.
    ways = [(Path(",".join(pieces[:k])), Path(",".join(pieces[k:]))) for k in range(1, len(pieces))]
    if not ways:
        raise InputError(f"--channel {pair}: expected two paths with a comma between them, FIXED,MOVING")
    existing = next((way for way in ways if way[0].exists() and way[1].exists()), ways[0])
    fixed, moving = (str(path.absolute()) for path in existing)
    return {"kind": "images", "name": f"channel_{number}", "fixed": fixed, "moving": moving}


def _describe_organ(data: FilesData) -> str:
    if data.intracranial is not None:
        return f"all of {data.intracranial}"
    return "what is bright in the fixed image and in view of the moving one"


def _choose_table(labels: Path, table: str | None) -> tuple[Mapping[str, Any], str]:
    """Choose the label table, and return it with a description of its source."""
    if table not in (None, "mask"):
        if table in TABLES:
            return TABLES[table], table
        if not Path(table).is_file():
            raise InputError(f"--table {table}: neither a file nor one of {', '.join(TABLES)}")
        return read_mapping(table), table
    values = np.unique(load_whole_numbers(labels).voxels).tolist()
    if len(values) == 2 and values[0] == 0:
        return {ORGAN: values[1:]}, "a mask, all of one tissue"
    fitting = recognise_tables(values)
    if not fitting:
        raise InputError(
            f"no label table fits the labels in {labels} ({shorten(values)}); give --table: {', '.join(TABLES)}, or a "
            "YAML file with labels by tissue, such as liver: [1]"
        )
    also = f", as {' and '.join(fitting[1:])} would (--table)" if fitting[1:] else ""
    return TABLES[fitting[0]], f"{fitting[0]}, which fits the values{also}"


def _describe_grid(grid: Grid) -> str:
    shape = " × ".join(map(str, grid.shape[:3]))
    sizes = " × ".join(f"{size:.3g}" for size in np.linalg.norm(grid.affine[:3, :3], axis=0))
    return f"{shape} voxels of {sizes} mm"
