"""Conversion of draws to ArviZ data and back, in memory and in files.

No other module depends on the version of ArviZ. Versions 0.23 (InferenceData) and 1.x (xarray.DataTree) take draws in
different forms, and read each other's NetCDF files. ArviZ takes a second to import, so the functions import it.
"""

from __future__ import annotations

import errno
import shutil
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import netCDF4
import numpy as np
import platformdirs
import xarray as xr

from bayesreg.inference.draws.blocks import Block, Blocks
from bayesreg.inference.target import Target
from bayesreg.types import InputError

_OLD = int(version("arviz").split(".")[0]) < 1

STATISTICS = (
    "lp", "acceptance_rate", "similarity_energy", "strain_energy", "solver_iterations", "solver_failed",
    "outside_support", "diverging", "n_steps",
)  # fmt: skip
# Rates and counts cover the steps between a draw and the draw before it.
MEANINGS = {
    "lp": "log posterior density, up to a constant",
    "acceptance_rate": "mean acceptance probability",
    "similarity_energy": "E_s, eq. (1)",
    "strain_energy": "E_r, eq. (3)",
    "solver_iterations": "conjugate-gradient iterations of an elastic solve, mean",
    "solver_failed": "elastic solves that failed",
    "outside_support": "proposals outside of the support",
    "diverging": "whether the energy error of a trajectory was beyond bounds",
    "n_steps": "gradients of the log density",
}
# Variables of the posterior that are functions of estimands.
DERIVED = ("ratio",)
# A chunk of the file holds PIECE nodes (or modes, elements) and STRETCH draws of every chain. It is then cheap to read
# few nodes of all draws, and all nodes of few draws.
PIECE, STRETCH = 64, 100
# The numbers (32 MB) that are written at once, unless one block has more. Each write costs as much as some thousands of
# numbers.
WRITTEN_AT_ONCE = 2**22


def to_inference_data(target: Target, blocks: Blocks) -> Any:
    """Convert blocks of draws to ArviZ data.

    Parameters
    ----------
    target : Target
        The target whose variables define the names of the draws and the known entries.
    blocks : Blocks
        Arrays (chain, draw, …) of the estimands and of `STATISTICS`.

    Returns
    -------
    arviz.InferenceData or xarray.DataTree
        The groups posterior, sample_stats and constant_data. The posterior holds u_boundary (chain, draw, node, axis)
        in mm, and lam, mu and ratio = λ/μ (chain, draw, tissue), including known entries. If they were sampled, it
        holds t_similarity, t_elastic and field_sd (chain, draw), and field (chain, draw, mode), the components of the
        log-stiffness.
    """
    az, variables = arviz(), target.variables
    all_blocks = list(blocks)
    draws = {name: np.concatenate([block[name] for block in all_blocks], axis=1) for name in all_blocks[0]}
    estimands = {name: value for name, value in draws.items() if name not in STATISTICS}
    groups: dict[str, Any] = {
        "posterior": variables.values(estimands),
        "sample_stats": {name: draws[name] for name in STATISTICS},
        "constant_data": {name: np.asarray(value) for name, value in variables.constants.items()},
    }
    labels: dict[str, Any] = {
        "coords": dict(variables.coords),
        "dims": {name: list(dims) for name, dims in variables.dims.items()},
    }
    idata = az.from_dict(**groups, **labels) if _OLD else az.from_dict(groups, **labels)
    for group in ("posterior", "constant_data"):
        for name, attributes in variables.attributes.items():
            if name in getattr(idata, group):
                getattr(idata, group)[name].attrs.update(attributes)
    for name, meaning in MEANINGS.items():
        idata.sample_stats[name].attrs["long_name"] = meaning
    return idata


def to_blocks(target: Target, idata: Any, length: int) -> Iterator[Block]:
    """Yield blocks of `length` draws of each chain from ArviZ data; the last block may be shorter.

    This is the inverse of `to_inference_data`.
    """
    posterior, statistics = dataset(idata, "posterior"), dataset(idata, "sample_stats")
    for first in range(0, posterior.sizes["draw"], length):
        rows = slice(first, first + length)
        values = {str(name): variable.isel(draw=rows).to_numpy().astype(float) for name, variable in posterior.items()}
        yield target.variables.estimands(values) | {
            name: statistics[name].isel(draw=rows).to_numpy() for name in STATISTICS
        }


def arviz() -> Any:
    """Import ArviZ without its announcement of version 1, which is meant for its direct users.

    ArviZ records in the user's cache that it has shown the announcement. If the cache is full or read-only, the import
    fails. So a temporary folder replaces the cache during the import.
    """
    if "arviz" in sys.modules:
        return sys.modules["arviz"]
    with warnings.catch_warnings(), TemporaryDirectory() as folder:
        warnings.filterwarnings("ignore", r"\s*ArviZ is undergoing a major refactor", FutureWarning)
        original_cache_dir, platformdirs.user_cache_dir = platformdirs.user_cache_dir, lambda *_, **__: folder
        try:
            import arviz
        finally:
            platformdirs.user_cache_dir = original_cache_dir

    return arviz


def dataset(idata: Any, group: str) -> xr.Dataset:
    """Return one group of ArviZ data as an xarray Dataset, for both versions of ArviZ."""
    group_data = getattr(idata, group)
    return group_data if isinstance(group_data, xr.Dataset) else group_data.to_dataset()


def save_posterior(target: Target, blocks: Blocks, path: str | Path) -> None:
    """Write draws as NetCDF, with displacements in single precision and compressed; hold few blocks in memory.

    The file opens as the ArviZ data that `to_inference_data` makes of all blocks.
    """
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    try:
        with _storing(path):
            batches = _together(blocks)
            _begin(to_inference_data(target, next(batches)), partial)
            with netCDF4.Dataset(partial, "a") as file:
                for following in batches:
                    _extend(file, to_inference_data(target, following))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _together(blocks: Blocks) -> Iterator[list[Block]]:
    """Yield lists of consecutive blocks; each list is written at once."""
    batch: list[Block] = []
    held = 0
    for block in blocks:
        size = sum(values.size for values in block.values())
        if batch and held + size > WRITTEN_AT_ONCE:
            yield batch
            batch, held = [], 0
        batch.append(block)
        held += size
    yield batch


@contextmanager
def _storing(path: Path) -> Iterator[None]:
    """Raise OSError with a reason if NetCDF cannot write; NetCDF itself raises a RuntimeError without a reason."""
    try:
        yield
    except RuntimeError as error:
        if "NetCDF" not in str(error):
            raise
        full = shutil.disk_usage(path.parent).free < 2**20
        raise OSError(errno.ENOSPC if full else errno.EIO, f"cannot be written ({error})", str(path)) from error


def _begin(idata: Any, path: Path) -> None:
    """Write a file with the first draws, to which more draws can be appended."""
    for index, group in enumerate(_groups(idata)):
        data = dataset(idata, group)
        encoding: dict[Any, dict[str, Any]] = {
            name: {"chunksizes": tuple(_piece(str(dim), size) for dim, size in values.sizes.items())}
            for name, values in data.variables.items()
            if "draw" in values.dims and values.size
        }
        if "u_boundary" in encoding:
            encoding["u_boundary"] |= {"dtype": "float32", "zlib": True, "complevel": 1}
        more = {"draw"} & set(data.dims)
        data.to_netcdf(path, mode="a" if index else "w", group=group, engine="netcdf4",
                       encoding=encoding, unlimited_dims=more)  # fmt: skip


def _piece(dim: str, size: int) -> int:
    return {"chain": size, "draw": STRETCH}.get(dim, min(size, PIECE))


def _extend(file: netCDF4.Dataset, idata: Any) -> None:
    for group in _groups(idata):
        data, file_group = dataset(idata, group), file[group]
        if "draw" not in data.dims:
            continue
        first = len(file_group.dimensions["draw"])
        rows = slice(first, first + data.sizes["draw"])
        for name, values in data.variables.items():
            if "draw" in values.dims:
                where = tuple(rows if dim == "draw" else slice(None) for dim in values.dims)
                file_group[str(name)][where] = values.to_numpy() + (first if name == "draw" else 0)


def append_groups(path: str | Path, groups: Mapping[str, xr.Dataset]) -> None:
    """Add groups, such as `log_likelihood`, to a file of `save_posterior`; replace groups with the same names."""
    for name, data in groups.items():
        encoding = {variable: {"zlib": True, "complevel": 1} for variable in data.data_vars}
        with _storing(Path(path)):
            data.to_netcdf(path, mode="a", group=name, engine="netcdf4", encoding=encoding)


def _groups(idata: Any) -> list[str]:
    return list(idata.groups()) if _OLD else [name.strip("/") for name in idata.groups if name != "/"]


def open_posterior(path: str | Path) -> Any:
    """Read draws written by `save_posterior`; raise InputError if the file is missing."""
    if not Path(path).is_file():
        raise InputError(f"{path} is missing: the folder holds no draws")
    return arviz().from_netcdf(str(path))
