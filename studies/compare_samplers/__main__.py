"""What does an effective draw cost with each sampler, on the posterior of one configuration?

    python -m studies.compare_samplers CONFIG -o DIR [--samplers hmc,nuts] [--minutes 5] [--set KEY=VALUE …]

The program prints a table. It writes the same numbers to DIR/samplers.json, and the configuration to DIR/config.yaml.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from bayesreg.config import Config, load_config, resolved_yaml
from bayesreg.config.samplers import sampler_section
from bayesreg.config.sections import StopConfig
from bayesreg.inference.chains.stopping import StopRule
from bayesreg.inference.samplers.registry import SAMPLERS
from bayesreg.io.atomic import write_json, write_text
from bayesreg.io.run_folder import RunFolder
from bayesreg.messages import show_messages
from bayesreg.types import InputError
from bayesreg.workflow.assembly import posterior_of, start_of
from bayesreg.workflow.beginning import temper
from bayesreg.workflow.preparation import prepared_inputs
from studies.compare_samplers.efficiency import Budget, Efficiency, measure_efficiency
from studies.compare_samplers.table import Setting, efficiency_table
from studies.terminal import in_terminal

BLOCK = 50


def compare_samplers(
    config: str | Path | Config,
    out: str | Path,
    samplers: Sequence[str] = tuple(SAMPLERS),
    minutes: float = 5.0,
    progress: bool = True,
) -> list[Efficiency]:
    """Draw from one posterior with each of several samplers, and write the cost of an effective draw.

    Parameters
    ----------
    config : path or Config
        Its `sampler` section applies to the sampler of that name. The others have their default settings, and the same
        number of chains.
    out : path
        A new or empty folder for samplers.json and config.yaml.
    samplers : sequence of str
        Names in `bayesreg.inference.samplers.registry.SAMPLERS`. Each sampler makes its own search for the mode and its
        own warm-up.
    minutes : float
        The budget of each sampler, positive. A sampler ends earlier if it meets the rule of `config.stop`.
    progress : bool
        Print the progress.

    Returns
    -------
    list of Efficiency

    Raises
    ------
    InputError
        If a name is unknown, the budget is not positive, or the configuration, a file or the folder is wrong.
    """
    _require_sound(samplers, minutes)
    config = config if isinstance(config, Config) else load_config(config)
    RunFolder(Path(out)).require_fresh()
    console = Console(quiet=not progress, highlight=False)
    console.print("reading the images, meshing")
    inputs = prepared_inputs(config)[0]
    posterior, setting = posterior_of(config, inputs), _setting(config, minutes)
    start = start_of(config, inputs, posterior)
    posterior = temper(config, inputs, posterior)
    rule = StopRule(config.stop.rhat, config.stop.ess, 60 * minutes)
    efficiencies: list[Efficiency] = []
    for name in samplers:
        console.print(f"{name}:")
        section = config.sampler if config.sampler.name == name else sampler_section(name)
        budget = Budget(config.sampler.chains, max(config.stop.max_steps // section.thin, 4), rule)
        efficiencies.append(
            measure_efficiency(
                posterior,
                name,
                budget,
                config.seed,
                thin=section.thin,
                block=section.block or BLOCK,
                start=start,
                **section.settings,
            )
        )
        console.print(f"  {efficiencies[-1].note or f'{efficiencies[-1].seconds:.0f} s'}")
        # The file is written after each sampler, so that an interrupted comparison keeps its results.
        Path(out).mkdir(parents=True, exist_ok=True)
        rows = [efficiency._asdict() for efficiency in efficiencies]
        write_json(Path(out) / "samplers.json", {**setting._asdict(), "samplers": rows})
    write_text(Path(out) / "config.yaml", resolved_yaml(config))
    table = efficiency_table(efficiencies, setting)
    console.print(in_terminal(table), table.caption)
    return efficiencies


def _require_sound(samplers: Sequence[str], minutes: float) -> None:
    for name in samplers:
        if name not in SAMPLERS:
            raise InputError(f"unknown sampler {name!r}; there are {', '.join(SAMPLERS)}")
    if not samplers or len({*samplers}) < len(samplers):
        raise InputError(f"expected one or more samplers, none of them twice; got {', '.join(samplers) or 'none'}")
    if not minutes > 0:
        raise InputError(f"minutes must be positive, got {minutes:g}")


def _setting(config: Config, minutes: float) -> Setting:
    return Setting(config.description, config.sampler.chains, minutes, _rule(config.stop))


def _rule(stop: StopConfig) -> str:
    if stop.rhat is None:
        return "there is none"
    return f"R̂ below {stop.rhat:g}" + (f" and ESS above {stop.ess:g}" if stop.ess is not None else ", unsplit")


def main() -> None:
    """Read the command line, and compare the samplers."""
    parser = argparse.ArgumentParser(prog="python -m studies.compare_samplers")
    parser.add_argument("config", metavar="CONFIG")
    parser.add_argument("-o", "--out", required=True, metavar="DIR")
    parser.add_argument("--samplers", default=",".join(SAMPLERS), help="names with commas between; default: all")
    parser.add_argument("--minutes", type=float, default=5.0, help="budget of each sampler")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override an entry")
    arguments = parser.parse_args()
    with show_messages():
        compare_samplers(
            load_config(arguments.config, arguments.set),
            arguments.out,
            arguments.samplers.split(","),
            arguments.minutes,
        )


if __name__ == "__main__":
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", ".jax_cache")
    main()
