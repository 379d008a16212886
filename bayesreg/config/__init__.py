"""The configuration of a run: pydantic models and their YAML form.

A configuration holds no arrays and builds nothing; `bayesreg.workflow.run` does that.
"""

from bayesreg.config.configuration import Config
from bayesreg.config.errors import ConfigError
from bayesreg.config.loading import (
    load_config,
    load_stored_config,
    make_config,
    model_of,
    read_mapping,
    resolved_yaml,
    schema,
)

__all__ = [
    "Config",
    "ConfigError",
    "load_config",
    "load_stored_config",
    "make_config",
    "model_of",
    "read_mapping",
    "resolved_yaml",
    "schema",
]
