"""The synthetic pair of a configuration, in a folder."""

from __future__ import annotations

import time
from pathlib import Path

from bayesreg.config import Config, load_config
from bayesreg.io import store
from bayesreg.types import InputError
from bayesreg.workflow.preparation import prepared_inputs, store_inputs, with_unsampled


def simulate(config: str | Path | Config, out: str | Path) -> Path:
    """Make the synthetic pair of a configuration: images, tissue, skull, mesh and truth in a folder."""
    config = config if isinstance(config, Config) else load_config(config)
    if config.simulate is None:
        raise InputError("the configuration has no section 'simulate': its pair comes from files")
    began = time.perf_counter()
    store.require_fresh(out)
    inputs, provenance = prepared_inputs(config)
    store_inputs(Path(out), inputs, with_unsampled(provenance, began))
    return Path(out)
