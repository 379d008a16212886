"""From a configuration to a run folder: the only place that wires everything together.

Reports are imported where they are written: no run waits at its start for what draws them at its end.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from bayesreg.assembly import posterior_of, start_of, with_initial
from bayesreg.config import Config, load_config, resolved_yaml
from bayesreg.inference.checkpoint import Block, Blocks, Checkpoint, checkpoint_to_arrays
from bayesreg.inference.devices import is_first, require_joined, wait
from bayesreg.inference.diagnostics import Convergence, convergence
from bayesreg.inference.draws import dataset, open_posterior, save_posterior, to_blocks
from bayesreg.inference.run import (
    Samples,
    checkpoint_from_arrays,
    first_checkpoint,
    sample,
)
from bayesreg.inference.stopping import StopRule
from bayesreg.io import store
from bayesreg.io.atomic import write_text
from bayesreg.io.store import Inputs, Run
from bayesreg.manifest import manifest
from bayesreg.mesh import TetMesh
from bayesreg.model.posterior import Posterior
from bayesreg.model.warp import nodal_field_on_grid, warp_image
from bayesreg.prediction import predict, require_inside
from bayesreg.preparation import prepare
from bayesreg.report.metrics import compute_metrics
from bayesreg.types import InputError

# Draws between two looks at the stop rule with up to so many quadrature points, and the fewest: for each block the
# whole state is written.
BLOCK, POINTS, FEWEST = 100, 20_000, 10
PROVENANCE = Path("inputs") / "provenance.json"
# Where several processes wait for one another.
BEGUN, KEPT, SAMPLED, ENDED = (
    "the run has begun",
    "a block of draws is kept",
    "all draws are judged",
    "the run has ended",
)


@dataclass(frozen=True, eq=False)
class Result:
    """A finished run.

    Attributes
    ----------
    folder : Path
    run : bayesreg.io.store.Run
        Mesh, images, posterior mean and sd of u at every node, manifest, metrics.
    """

    folder: Path
    run: Run

    @cached_property
    def idata(self) -> Any:
        """The draws, as ArviZ opens them."""
        return open_posterior(self.folder / "posterior.nc")

    @cached_property
    def convergence(self) -> Convergence:
        """R̂ and effective sample sizes of every estimand."""
        return convergence(self.idata)

    @property
    def mesh(self) -> TetMesh:
        """The mesh of the registration."""
        return self.run.mesh

    @property
    def u_mean(self) -> np.ndarray:
        """Posterior mean displacement of every node, (n, 3), mm."""
        return np.asarray(self.run.u_mean)

    @property
    def u_sd(self) -> np.ndarray:
        """Posterior standard deviation of the displacement of every node, (n, 3), mm."""
        return np.asarray(self.run.u_sd)

    @property
    def metrics(self) -> dict[str, Any] | None:
        """The paper's Tables 1 and 2 and the coverage of intervals, where the truth is known."""
        return self.run.metrics

    @property
    def converged(self) -> bool | None:
        """Whether the stop rule held and the report's rank-normalised R̂ agrees; None where no rule was set."""
        return self.run.manifest["stopped"]["converged"]

    @property
    def report(self) -> Path:
        """The HTML report."""
        return self.folder / "report.html"


def run(
    config: str | Path | Config,
    out: str | Path,
    resume: bool = False,
    progress: bool = True,
    observations: Sequence[Any] = (),
) -> Result:
    """Run a configuration from end to end.

    Parameters
    ----------
    config : path or Config
    out : path
        The run folder, new or empty; with `resume`, that of a run that was cut off, or of a finished one.
    resume : bool
        Continue after the last draws that were stored. Where the section `stop` differs from the one that the run was
        begun with, the new one holds: a finished run is given more draws so.
    progress : bool
        Say what is being done, and show a progress bar.
    observations : sequence
        What was observed besides the two images, such as `bayesreg.Landmarks`; see `bayesreg.build_posterior`. A run
        that began with some is resumed with the same.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If the configuration, a file or an observation is wrong, or the folder holds another run; if the section
        `distributed` is given and `bayesreg.inference.devices.join` was not called.
    """
    config = config if isinstance(config, Config) else load_config(config)
    if config.distributed is not None:
        return _run_together(config, Path(out), resume, progress, observations)
    return _run(config, Path(out), resume, progress, observations)


def _run_together(config: Config, out: Path, resume: bool, progress: bool, observations: Sequence[Any]) -> Result:
    """The first of several processes runs, and the others join it as if they resumed what it began.

    A folder that all of them see is how they come to one mesh and one start; the first alone writes to it.
    """
    require_joined(config.sampler.chains)
    # Where a run is made is no part of it.
    config = config.model_copy(update={"distributed": None})
    if is_first():
        result = _run(config, out, resume, progress, observations)
        wait(ENDED)
        return result
    wait(BEGUN)
    if not (out / "run.json").exists():
        begun, inputs = load_config(out / "config.yaml"), store.read_inputs(out)
        posterior = posterior_of(begun, inputs, observations)
        _sample(begun, posterior, _reached(begun, inputs, posterior, out, progress=False), out, progress=False)
        wait(SAMPLED)
    wait(ENDED)
    return load_result(out)


def _run(config: Config, out: Path, resume: bool, progress: bool, observations: Sequence[Any]) -> Result:
    began = time.perf_counter()
    say = _narrator(progress)
    if resume and (out / "config.yaml").exists():
        known = _resumed_config(out, config)
        if (out / "run.json").exists() and known.stop == config.stop:
            say(f"{out} holds a finished run already; another budget (stop) would continue it")
            if not (out / "report.html").exists():
                report(out)
            wait(BEGUN)
            return load_result(out)
        inputs, provenance = store.read_inputs(out), store.read_json(out / PROVENANCE)
        _require_same_observations(out, provenance, observations)
        posterior = posterior_of(config, inputs, observations)
        if (out / "run.json").exists():
            store.reopen(out, to_blocks(posterior, load_result(out).idata, BLOCK))
        inputs = with_initial(inputs._replace(config=resolved_yaml(config)), config)
        write_text(out / "config.yaml", inputs.config)
        reached = _reached(config, inputs, posterior, out, progress)
        sampled = float(reached[0].seconds)
        began -= provenance["unsampled"] + sampled
        store.write_json(out / PROVENANCE, _timed(provenance, began + sampled))
    else:
        # A run that was cut off before its configuration was written has nothing yet that is worth keeping.
        if not (resume and (out / PROVENANCE).exists()):
            store.require_fresh(out)
        say("reading the images, meshing")
        inputs, provenance = prepared_inputs(config)
        # Nothing is written before all input has proved sound, and all of it before the first step is taken.
        posterior = posterior_of(config, inputs, observations)
        provenance["observations"] = _names(observations)
        reached = _first(config, inputs, posterior, out, progress)
        inputs = with_initial(inputs, config)
        _store(out, inputs, _timed(provenance, began))
    _save_state(out, *reached)
    say(_described(inputs))
    wait(BEGUN)
    samples = _sample(config, posterior, reached, out, progress)
    wait(SAMPLED)
    say("writing the results")
    result = _finish(config, inputs, posterior, samples, provenance, out, began)
    say(f"{samples.reason}")
    return result


def check(config: str | Path | Config) -> Check:
    """Everything but sampling, with an estimate of time and memory."""
    config = config if isinstance(config, Config) else load_config(config)
    inputs, provenance = prepared_inputs(config)
    posterior = posterior_of(config, inputs)
    start = start_of(config, inputs, posterior)
    options, trial, reached = config.sampler, 10, []

    def keep(_index: int, _block: Block, checkpoint: Checkpoint) -> None:
        reached.append(float(checkpoint.seconds))

    # Two blocks: the first holds the compilation.
    sample(posterior, options.name, options.chains, 2 * trial, config.seed, block=trial, start=start,
           progress=False, on_block=keep, **options.settings)  # fmt: skip
    seconds_per_step = (reached[1] - reached[0]) / trial
    device = sum(leaf.nbytes for leaf in jax.tree.leaves(posterior.data))
    draws = config.stop.max_steps // options.thin
    numbers = sum(np.size(value) for value in posterior.estimands(posterior.reference()).values()) + 8
    return Check(
        nodes=len(inputs.mesh.points),
        cells=len(inputs.mesh.cells),
        sampled=len(posterior.sampled),
        steps_per_second=1 / seconds_per_step,
        hours=config.stop.max_steps * seconds_per_step / 3600,
        device_bytes=device,
        draws_bytes=draws * options.chains * numbers * 8,
        preparation=provenance["timings"],
    )


@dataclass(frozen=True)
class Check:
    """What a configuration would cost; `text` says it."""

    nodes: int
    cells: int
    sampled: int
    steps_per_second: float
    hours: float
    device_bytes: int
    draws_bytes: int
    preparation: dict[str, float]

    @property
    def text(self) -> str:
        """The estimate in words."""
        preparation = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in self.preparation.items())
        return (
            "The configuration is sound.\n"
            f"  mesh      {self.nodes} nodes, {self.cells} elements, {self.sampled} nodes sampled\n"
            f"  prepared  {preparation}\n"
            f"  speed     about {self.steps_per_second:.0f} steps per second and chain\n"
            f"  time      {self.hours:.1f} h for all the steps that stop.max_steps allows\n"
            f"  memory    {self.device_bytes / 1e6:.0f} MB on the device, whatever the number of draws; "
            f"{self.draws_bytes / 1e6:.0f} MB of draws on the host at most"
        )


def simulate(config: str | Path | Config, out: str | Path) -> Path:
    """Make the synthetic pair of a configuration: images, tissue, skull, mesh and truth in a folder."""
    config = config if isinstance(config, Config) else load_config(config)
    if config.simulate is None:
        raise InputError("the configuration has no section 'simulate': its pair comes from files")
    began = time.perf_counter()
    store.require_fresh(out)
    inputs, provenance = prepared_inputs(config)
    _store(Path(out), inputs, _timed(provenance, began))
    return Path(out)


def load_result(folder: str | Path) -> Result:
    """Open a finished run; InputError where the folder holds none."""
    return Result(Path(folder), store.read_run(folder))


def report(folder: str | Path) -> Path:
    """Write the report of a finished run anew, and return its path."""
    from bayesreg.report.html import write_report

    result = load_result(folder)
    write_report(result.run, result.idata, *result.convergence, result.report)
    return result.report


def compare(folders: Sequence[str | Path], out: str | Path) -> Path:
    """Put runs side by side on one page, and return its path."""
    from bayesreg.report.compare import write_comparison

    if not Path(out).absolute().parent.is_dir():
        raise InputError(f"{out} cannot be written: there is no folder {Path(out).parent}")
    results = [load_result(folder) for folder in folders]
    write_comparison([(r.run, r.idata, *r.convergence) for r in results], out)
    return Path(out)


def prepared_inputs(config: Config) -> tuple[Inputs, dict[str, Any]]:
    """The images, mesh and truth of a configuration, and where they come from."""
    prepared = prepare(config)
    require_inside(prepared.inputs.mesh, config.report.landmarks)
    return prepared.inputs, {"timings": prepared.timings, "pair": prepared.pair}


def _timed(provenance: dict[str, Any], began: float) -> dict[str, Any]:
    """With the seconds spent on all but sampling, which a resumed run adds to its own."""
    return provenance | {"unsampled": time.perf_counter() - began}


def _resumed_config(out: Path, config: Config) -> Config:
    """The configuration that a run was begun with; InputError if it differs in more than its budget."""
    known = load_config(out / "config.yaml")
    if resolved_yaml(known.model_copy(update={"stop": config.stop})) != resolved_yaml(config):
        raise InputError(
            f"{out} holds a run of another configuration; resume it with its own ({out / 'config.yaml'}), of which "
            "only the section stop may change, or name another folder"
        )
    return known


def _names(observations: Sequence[Any]) -> list[str]:
    return [observation.name for observation in observations]


def _require_same_observations(out: Path, provenance: dict[str, Any], observations: Sequence[Any]) -> None:
    """Raise InputError where a run would go on with other observations than it began with."""
    begun, given = provenance.get("observations", []), _names(observations)
    if begun != given:
        raise InputError(
            f"the run in {out} began with the observations {begun or 'none'} besides its images, and is resumed with "
            f"{given or 'none'}: give the same to bayesreg.run(..., observations=[...])"
        )


def _narrator(progress: bool) -> Callable[[str], None]:
    console = Console(quiet=not progress, highlight=False)
    return lambda text: console.print(text)


def _described(inputs: Inputs) -> str:
    mesh = inputs.mesh
    return f"mesh of {len(mesh.points)} nodes ({len(mesh.boundary)} on the boundary) and {len(mesh.cells)} elements"


def _store(out: Path, inputs: Inputs, provenance: dict[str, Any]) -> None:
    (out / PROVENANCE).parent.mkdir(parents=True, exist_ok=True)
    store.write_json(out / PROVENANCE, provenance)
    store.write_inputs(out, inputs)


Reached = tuple[Checkpoint, Blocks]


def _first(config: Config, inputs: Inputs, posterior: Posterior, out: Path, progress: bool) -> Reached:
    """The chains before their first step; InputError where one cannot start."""
    options, start = config.sampler, start_of(config, inputs, posterior)
    found = first_checkpoint(
        posterior, options.name, options.chains, config.seed, start, _narrator(progress), **options.settings
    )
    return found, store.StoredBlocks(out, 0, writes=is_first())


def _reached(config: Config, inputs: Inputs, posterior: Posterior, out: Path, progress: bool) -> Reached:
    """The chains as the run that was cut off stored them last."""
    state = store.load_state(out)
    if state is None:
        return _first(config, inputs, posterior, out, progress)
    blocks = store.StoredBlocks(out, int(state.pop("blocks")), writes=is_first())
    options = config.sampler
    return checkpoint_from_arrays(state, posterior, options.name, options.chains, **options.settings), blocks


def _save_state(out: Path, checkpoint: Checkpoint, blocks: Blocks) -> None:
    store.save_state(out, {"blocks": np.array(len(blocks)), **checkpoint_to_arrays(checkpoint)})


def _sample(config: Config, posterior: Posterior, reached: Reached, out: Path, progress: bool) -> Samples:
    def keep(_index: int, _block: Block, checkpoint: Checkpoint) -> None:
        if is_first():
            _save_state(out, checkpoint, reached[1])
        wait(KEPT)

    options = config.sampler
    return sample(
        posterior,
        options.name,
        options.chains,
        config.stop.max_steps // options.thin,
        config.seed,
        thin=options.thin,
        block=options.block or _block(len(posterior.images.quadrature.weights)),
        stop=StopRule(config.stop.rhat, config.stop.ess, config.stop.max_minutes and 60 * config.stop.max_minutes),
        progress=progress,
        resume=reached,
        on_block=keep,
        **options.settings,
    )


def _block(points: int) -> int:
    """Fewer draws where a step costs more, or no look would come before a time limit is long over.

    By the size of the problem and not by the clock: where a run ends is part of what a seed repeats.
    """
    return max(BLOCK * POINTS // max(points, POINTS), FEWEST)


def _finish(
    config: Config,
    inputs: Inputs,
    posterior: Posterior,
    samples: Samples,
    provenance: dict[str, Any],
    out: Path,
    began: float,
) -> Result:
    """Everything after the last draw: the files of the run folder, run.json last but for the report."""
    from bayesreg.report.html import write_report

    save_posterior(posterior, samples.blocks, out / "posterior.nc")
    idata = open_posterior(out / "posterior.nc")
    draws, judged = dataset(idata, "posterior"), convergence(idata)
    moments = np.concatenate([samples.u_mean, samples.u_sd], axis=1)
    mean_field, sd_field = np.split(nodal_field_on_grid(inputs.mesh, moments, inputs.fixed), 2, axis=-1)
    metrics = None
    if inputs.truth is not None:
        metrics = compute_metrics(inputs.mesh, samples.u_mean, inputs.truth, draws)
    predicted = predict(posterior, draws, samples.u_mean, samples.u_sd, config.report.landmarks, config.seed)
    finished = Run(
        manifest=manifest(config, inputs, posterior, samples, draws, judged, provenance, began),
        u_mean=samples.u_mean,
        u_sd=samples.u_sd,
        warped=warp_image(inputs.moving, mean_field, inputs.fixed),
        metrics=metrics,
        predicted=predicted,
        bodies=store.read_bodies(out),
        **inputs._asdict(),
    )
    store.write_results(out, finished, mean_field, sd_field)
    store.remove_blocks(out)
    result = Result(out, finished)
    write_report(finished, idata, *judged, result.report)
    return result
