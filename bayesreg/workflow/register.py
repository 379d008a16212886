"""From the paths of a pair to its configuration, and what was understood of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayesreg.config import Config, make_config, read_mapping
from bayesreg.config.data import FilesData
from bayesreg.image import Image
from bayesreg.io.volumes import load_image
from bayesreg.label_tables import TABLES, recognise_table
from bayesreg.types import InputError


class Understood(NamedTuple):
    """A configuration that was made of paths.

    Attributes
    ----------
    config : Config
    lines : tuple of str
        What was understood: grids, labels, mask and choices, to be read before anything long begins.
    """

    config: Config
    lines: tuple[str, ...]


def understand(
    fixed: Path,
    moving: Path,
    labels: Path,
    table: str | None = None,
    intracranial: Path | None = None,
    overrides: Sequence[str] = (),
) -> Understood:
    """Make the configuration of a pair in files.

    Parameters
    ----------
    fixed, moving, labels : path
        Two images, and tissue labels of the fixed one.
    table : str, optional
        The name of a label table (`bayesreg.label_tables`), or a YAML file with labels by tissue; where it is left out,
        the values of the labels tell.
    intracranial : path, optional
        Mask of where the organ may go.
    overrides : sequence of str
        As in `bayesreg.load_config`.

    Raises
    ------
    InputError
        If a file is missing or unreadable, no table fits the labels, or an override is wrong.
    """
    images = {"fixed": load_image(fixed), "moving": load_image(moving), "labels": load_image(labels)}
    chosen, how = _choose_table(images["labels"], labels, table)
    paths = {"fixed": fixed, "moving": moving, "labels": labels, "intracranial": intracranial}
    files = {name: str(path.absolute()) for name, path in paths.items() if path is not None}
    config = make_config({"data": {"source": "files", "label_table": chosen, **files}}, overrides)
    assert isinstance(config.data, FilesData)
    lines = [f"{name:<12}{paths[name]}: {_describe_grid(image)}" for name, image in images.items()]
    tissues = "; ".join(f"{name} {_shorten(values)}" for name, values in (config.data.label_table or {}).items())
    mask = "none: nothing bounds the motion" if intracranial is None else str(intracranial)
    lines += [
        f"{'table':<12}{how}: {tissues}",
        f"{'mask':<12}{mask}",
        f"{'pose':<12}as the headers say; only the deformation is looked for",
        f"{'contrast':<12}compared by {config.model.similarity}; the model is preset {config.model.preset}",
    ]
    return Understood(config, tuple(lines))


def _choose_table(labels: Image, path: Path, table: str | None) -> tuple[Mapping[str, Any], str]:
    """A table, and where it is from."""
    if table is not None:
        if table in TABLES:
            return TABLES[table], table
        if not Path(table).is_file():
            raise InputError(f"--table {table}: neither a file nor one of {', '.join(TABLES)}")
        return read_mapping(table), table
    values = np.unique(np.rint(labels.voxels)).astype(int).tolist()
    name = recognise_table(values)
    if name is None:
        raise InputError(
            f"no label table fits the labels in {path} ({_shorten(values)}); give --table: {', '.join(TABLES)}, or a "
            "YAML file with labels by tissue, such as csf: [1]"
        )
    return TABLES[name], f"{name}, which fits the values"


def _describe_grid(image: Image) -> str:
    shape = " × ".join(map(str, image.shape))
    sizes = " × ".join(f"{size:.3g}" for size in image.voxel_sizes)
    return f"{shape} voxels of {sizes} mm"


def _shorten(values: Sequence[int], most: int = 12) -> str:
    """The first of some numbers."""
    return ", ".join(map(str, values[:most])) + (", …" if len(values) > most else "")
