"""Repeat a run from the content of its folder, and compare the draws bit by bit."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayesreg.config import load_stored_config, resolved_yaml
from bayesreg.config.configuration import Config
from bayesreg.config.sections import StopConfig
from bayesreg.inference.draws.inference_data import dataset
from bayesreg.io import store
from bayesreg.io.run_folder import RunFolder
from bayesreg.results.result import Result, load_result
from bayesreg.types import InputError
from bayesreg.workflow.preparation import PROVENANCE, store_inputs
from bayesreg.workflow.run import run

_log = logging.getLogger(__name__)

# Entries of run.json that describe the software and the machine of a run; if all are equal, the draws are identical.
WHERE = ("versions", "devices", "xla_flags", "machine", "cores")
GROUPS = ("posterior", "sample_stats")


class Comparison(NamedTuple):
    """The comparison of a run with its repetition.

    Attributes
    ----------
    result : Result
        The repetition.
    same : bool
        Whether all draws have the same bits.
    greatest_differences : dict
        The greatest difference of a draw, in units of the variable's standard deviation, by variable; only variables
        that differ.
    changed_entries : dict
        The entries of `WHERE` that changed: (then, now) by name.
    """

    result: Result
    same: bool
    greatest_differences: dict[str, float]
    changed_entries: dict[str, tuple[Any, Any]]

    @property
    def lines(self) -> list[str]:
        """The comparison in words, one line per difference."""
        changes = [
            f"{name} was {then or 'none'}, and is {now or 'none'}" for name, (then, now) in self.changed_entries.items()
        ]
        if self.same:
            return ["the draws are the same, bit for bit", *changes]
        differences = [
            f"{name} is up to {distance:.2g} sd apart" for name, distance in self.greatest_differences.items()
        ]
        return ["the draws are not the same", *differences, *(changes or ["nothing that run.json records tells why"])]


def reproduce(folder: str | Path, out: str | Path, progress: bool = True) -> Comparison:
    """Repeat the run in a folder, with its seed and its number of draws, and compare the draws.

    Parameters
    ----------
    folder : path
        The folder of a finished run. The preparation is not repeated: mesh, images and pose are read from this folder,
        and the original files may be missing.
    out : path
        Folder of the repetition, new or empty.
    progress : bool
        As in `bayesreg.run`.

    Raises
    ------
    InputError
        If the folder holds no finished run, or one that had observations besides those of its configuration.
    """
    first, first_folder, second_folder = load_result(folder), RunFolder(Path(folder)), RunFolder(Path(out))
    provenance = store.read_json(first_folder.file(PROVENANCE))
    if provenance.get("observations"):
        raise InputError(
            f"the run in {folder} had the observations {list(provenance['observations'])} from Python, which its "
            "folder does not hold"
        )
    second_folder.require_fresh()
    config = load_stored_config(first_folder.file("config.yaml"))
    config = _as_many(config, int(first.run.manifest["steps_per_chain"]))
    inputs = store.read_inputs(first_folder)._replace(config=resolved_yaml(config))
    with second_folder.locked():
        # No digests of sources: the original files may have changed or be missing.
        store_inputs(second_folder, inputs, provenance | {"sources": {}})
    steps, chains = first.run.manifest["steps_per_chain"], config.sampler.chains
    _log.info(f"{steps:,} steps of {chains} chains, with seed {config.seed}")
    return _compare(first, run(config, out, resume=True, progress=progress))


def _as_many(config: Config, steps: int) -> Config:
    """Set the budget to a number of steps only: the steps that fit into a time limit differ between runs."""
    stop = StopConfig(rhat=None, ess=None, max_steps=steps, max_minutes=None)
    return config.model_copy(update={"stop": stop})


def _compare(first: Result, second: Result) -> Comparison:
    distances = {}
    for group in GROUPS:
        first_data, second_data = dataset(first.idata, group), dataset(second.idata, group)
        for name in first_data.data_vars:
            then, now = first_data[name].to_numpy(), second_data[name].to_numpy()
            if then.shape != now.shape:
                distances[str(name)] = np.inf
            elif not np.array_equal(then, now, equal_nan=True):
                then, now = then.astype(float), now.astype(float)
                distances[str(name)] = float(np.nanmax(np.abs(then - now)) / max(np.nanstd(then), np.finfo(float).tiny))
    pairs = {name: (first.run.manifest.get(name), second.run.manifest.get(name)) for name in WHERE}
    changes = {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
    return Comparison(second, not distances, distances, changes)
