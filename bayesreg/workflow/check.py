"""Do every step of a run except sampling, and estimate the cost of sampling."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bayesreg.config import Config, load_config
from bayesreg.inference.chains.checkpoint import Checkpoint
from bayesreg.inference.chains.run import sample
from bayesreg.inference.draws.blocks import Block
from bayesreg.workflow.appraisal import Likeness
from bayesreg.workflow.assembly import posterior_of, start_of
from bayesreg.workflow.preparation import prepared_inputs

_log = logging.getLogger(__name__)


def check(config: str | Path | Config) -> Check:
    """Do every step of a run except sampling, and estimate time and memory.

    Parameters
    ----------
    config : path or Config
    """
    config = config if isinstance(config, Config) else load_config(config)
    inputs, provenance = prepared_inputs(config)
    posterior = posterior_of(config, inputs)
    _log.info("%s", describe_inputs(provenance["appraisal"]))
    start = start_of(config, inputs, posterior)
    options, trial, reached = config.sampler, 10, []

    def keep(_index: int, _block: Block, checkpoint: Checkpoint) -> None:
        reached.append(float(checkpoint.seconds))

    # Two blocks, because the time of the first includes the compilation.
    sample(posterior, options.name, options.chains, 2 * trial, config.seed, block=trial, start=start,
           progress=False, on_block=keep, **options.settings)  # fmt: skip
    seconds_per_step = (reached[1] - reached[0]) / trial
    device = sum(leaf.nbytes for leaf in jax.tree.leaves(posterior.data))
    draws = config.stop.max_steps // options.thin
    numbers = sum(np.size(value) for value in posterior.target.coordinates.reference().values()) + 8
    return Check(
        nodes=len(inputs.mesh.points),
        cells=len(inputs.mesh.cells),
        sampled=len(posterior.sampled),
        steps_per_second=1 / seconds_per_step,
        hours=config.stop.max_steps * seconds_per_step / 3600,
        device_bytes=device,
        draws_bytes=draws * options.chains * numbers * 8,
        preparation=provenance["timings"],
        appraisal=provenance["appraisal"],
    )


@dataclass(frozen=True)
class Check:
    """The cost of a configuration; `text` describes it in words."""

    nodes: int
    cells: int
    sampled: int
    steps_per_second: float
    hours: float
    device_bytes: int
    draws_bytes: int
    preparation: dict[str, float]
    appraisal: dict[str, Any]

    @property
    def text(self) -> str:
        """The findings on the inputs and the estimated cost, in words."""
        return f"{describe_inputs(self.appraisal)}\n{self.cost}"

    @property
    def cost(self) -> str:
        """The estimated cost in words."""
        preparation = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in self.preparation.items())
        return "\n".join(
            [
                f"  mesh      {self.nodes} nodes, {self.cells} elements, {self.sampled} nodes sampled",
                f"  prepared  {preparation}",
                f"  speed     about {self.steps_per_second:.0f} steps per second and chain",
                f"  time      {self.hours:.1f} h for all the steps that stop.max_steps allows",
                f"  memory    {self.device_bytes / 1e6:.0f} MB on the device, whatever the number of draws; "
                f"{self.draws_bytes / 1e6:.0f} MB of draws in the run's folder at most",
            ]
        )


def describe_inputs(appraisal: Mapping[str, Any]) -> str:
    """Describe the labels and images in words."""
    warnings = appraisal.get("warnings", [])
    verdict = "The configuration can be run, but with warnings:" if warnings else "The configuration is sound."
    return "\n".join([verdict, *(f"  - {sentence}" for sentence in warnings), *_describe(appraisal)])


def _describe(appraisal: Mapping[str, Any]) -> list[str]:
    """Describe the notes, the volumes of the tissues and the likeness of the images, one line each."""
    lines = [f"  {note}" for note in appraisal.get("notes", ())]
    if appraisal.get("millilitres"):
        volumes = (
            f"{name} {inside:.4g}" + (f" ({outside:.3g} outside)" if outside >= 0.01 * inside else "")
            for name, (inside, outside) in appraisal["millilitres"].items()
        )
        lines.append(f"  tissues   {', '.join(volumes)} ml in the region to mesh")
    if appraisal.get("likeness"):
        likeness = Likeness(**appraisal["likeness"])
        lines.append(
            f"  images    correlation {likeness.correlation:.2f}, normalised mutual information "
            f"{likeness.mutual_information:.2f}, {likeness.on_grid:.0%} of the region on the moving grid"
        )
    return lines
