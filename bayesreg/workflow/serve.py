"""Serve the posterior over HTTP on loopback, for clients of UM-Bridge in any language.

Seelinger et al., "UM-Bridge: Uncertainty quantification and modeling bridge", Journal of Open Source Software 8(83),
2023. The package umbridge is optional; `serve` imports it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayesreg.config import Config, load_config, load_stored_config
from bayesreg.inference.layout import slices, unravel
from bayesreg.io import store
from bayesreg.io.run_folder import RunFolder
from bayesreg.model.observations.images.likelihood import images_of
from bayesreg.model.posterior import Posterior
from bayesreg.model.problem import Problem
from bayesreg.types import InputError
from bayesreg.workflow.assembly import posterior_of
from bayesreg.workflow.beginning import temper
from bayesreg.workflow.preparation import PROVENANCE, prepared_inputs

_log = logging.getLogger(__name__)

LOG_POSTERIOR = "log_posterior"
LOOPBACK, PORT = "127.0.0.1", 4242
# JSON has neither infinity nor NaN. The least finite number replaces both; no sampler accepts it.
IMPOSSIBLE = float(np.finfo(float).min)

Vectors = Sequence[Sequence[float]]


class Served:
    """A function of a position as a model of UM-Bridge.

    Parameters
    ----------
    name : str
    function : callable
        Maps data and a flat position to the outputs, a list of vectors.
    data : Problem
    inputs : sequence of int
        Sizes of the parts of a position; empty for a model without input.
    """

    def __init__(
        self, name: str, function: Callable[[Any, Any], list[Any]], data: Problem, inputs: Sequence[int]
    ) -> None:
        self.name, self.data, self.inputs = name, data, list(inputs)
        self.outputs = [int(np.prod(output.shape)) for output in jax.eval_shape(function, data, jnp.zeros(sum(inputs)))]

        def pull(data: Any, position: Any, sensitivities: list[Any]) -> Any:
            return jax.vjp(partial(function, data), position)[1](sensitivities)[0]

        self._value, self._pulled = jax.jit(function), jax.jit(pull)

    def get_input_sizes(self, config: Any = None) -> list[int]:
        """Return the length of each input."""
        return self.inputs

    def get_output_sizes(self, config: Any = None) -> list[int]:
        """Return the length of each output."""
        return self.outputs

    def supports_evaluate(self) -> bool:
        """Report that the model gives values."""
        return True

    def supports_gradient(self) -> bool:
        """Report whether the model gives gradients: it does if it has an input."""
        return bool(self.inputs)

    def supports_apply_jacobian(self) -> bool:
        """Report that the model does not apply its Jacobian."""
        return False

    def supports_apply_hessian(self) -> bool:
        """Report that the model does not apply its Hessian."""
        return False

    def __call__(self, parameters: Vectors, config: Any = None) -> list[list[float]]:
        """Compute the outputs at a position.

        Raises
        ------
        InputError
            If an output is not finite. The log posterior is then `IMPOSSIBLE` and raises nothing.
        """
        outputs = [np.asarray(output, float).ravel() for output in self._value(self.data, self._position(parameters))]
        if self.name == LOG_POSTERIOR:
            outputs = [np.where(np.isfinite(output), output, IMPOSSIBLE) for output in outputs]
        return [_finite(output, self.name).tolist() for output in outputs]

    def gradient(
        self, out_wrt: int, in_wrt: int, parameters: Vectors, sens: Sequence[float], config: Any = None
    ) -> list[float]:
        """Compute the gradient of a weighted output with respect to an input: sensᵀ ∂output/∂input.

        Raises
        ------
        InputError
            If the gradient is not finite. The gradient of the log posterior is then zero.
        """
        sensitivities = [jnp.zeros(size) for size in self.outputs]
        sensitivities[out_wrt] = jnp.asarray(sens, float)
        pulled = self._pulled(self.data, self._position(parameters), sensitivities)
        first = sum(self.inputs[:in_wrt])
        gradient = np.asarray(pulled[first : first + self.inputs[in_wrt]], float)
        if self.name == LOG_POSTERIOR and not np.isfinite(gradient).all():
            gradient = np.zeros_like(gradient)
        return _finite(gradient, f"the gradient of {self.name}").tolist()

    def _position(self, parameters: Vectors) -> Any:
        return jnp.concatenate([jnp.asarray(vector, float) for vector in parameters]) if parameters else jnp.zeros(0)


def models_of(posterior: Posterior) -> list[Served]:
    """Make the models that are served for a posterior.

    Returns
    -------
    list of Served
        "log_posterior" is a function of a position; its inputs are the parts of the position (u_boundary and the
        parameters, mapped to the real line), and it includes the logarithm of the Jacobian. "forward" has the same
        inputs; its outputs are the displacement of every node, mm, node by node, and, if there are images, the
        intensities of the moving image at the quadrature points. "start" has no input; its outputs are the parts of the
        position at rest, where a sampler can begin.
    """
    unravel_position, blocks = unravel(posterior.target), slices(posterior.target)
    sizes = [block.stop - block.start for block in blocks.values()]

    # The data are an argument, because JAX would compile data of a closure as constants.
    def log_posterior(data: Any, position: Any) -> list[Any]:
        return [replace(posterior, data=data).logdensity(unravel_position(position))[None]]

    def forward(data: Any, position: Any) -> list[Any]:
        posterior_with_data = replace(posterior, data=data)
        estimands, images = posterior_with_data.constrain(unravel_position(position)), images_of(data)
        evaluation = posterior_with_data.evaluate(estimands)
        # The displacement is invalid if the solve failed, or was skipped outside the support.
        u = jnp.where(evaluation.solver_failed | evaluation.outside_support, jnp.nan, evaluation.u)
        return [u.ravel(), *([] if images is None else [images.predicted(u, posterior_with_data.fill(estimands))])]

    def start(data: Any, _: Any) -> list[Any]:
        at_rest = posterior.target.coordinates.unconstrain(data, posterior.estimands(posterior.reference()))
        return [jnp.ravel(at_rest[name]) for name in blocks]

    functions = {LOG_POSTERIOR: (log_posterior, sizes), "forward": (forward, sizes), "start": (start, [])}
    return [Served(name, function, posterior.data, inputs) for name, (function, inputs) in functions.items()]


def serve(config: str | Path | Config, port: int = PORT) -> None:
    """Serve the posterior of a configuration, or of a run's folder, until the process is stopped.

    Parameters
    ----------
    config : path or Config
        A configuration, or the folder of a run with stored inputs.
    port : int
        The port on loopback; other machines cannot reach it.

    Raises
    ------
    InputError
        If the configuration or the folder is wrong, the package umbridge is missing, or the port is taken.
    """
    try:
        from umbridge import um
    except ImportError as error:
        raise InputError("the package umbridge is missing: pip install 'bayesreg[serve]'") from error
    posterior = posterior_of_run(config)
    models = models_of(posterior)
    names = ", ".join(f"{name} ({block.stop - block.start})" for name, block in slices(posterior.target).items())
    served = ", ".join(model.name for model in models)
    _log.info("inputs: %s; serving %s at http://%s:%d", names, served, LOOPBACK, port)
    # By default umbridge accepts connections from every machine.
    run_app = um.web.run_app
    um.web.run_app = partial(run_app, host=LOOPBACK, print=None)
    try:
        um.serve_models(models, port)
    except OSError as error:
        raise InputError(f"nothing can be served at port {port}: {error.strerror}; name another one") from error
    finally:
        um.web.run_app = run_app


def posterior_of_run(config: str | Path | Config) -> Posterior:
    """Build the posterior that a run samples, from a configuration or from the folder of a run."""
    if not isinstance(config, Config) and Path(config).is_dir():
        folder = RunFolder(Path(config))
        if folder.stage is None:
            raise InputError(f"{config} holds no run of bayesreg, and is no configuration")
        settings, inputs = load_stored_config(folder.file("config.yaml")), store.read_inputs(folder)
        independent = store.read_json(folder.file(PROVENANCE)).get("independent_points")
        posterior = posterior_of(settings, inputs, (), independent)
    else:
        settings = config if isinstance(config, Config) else load_config(config)
        inputs, _ = prepared_inputs(settings)
        posterior = posterior_of(settings, inputs)
    return temper(settings, inputs, posterior)


def _finite(values: np.ndarray, name: str) -> np.ndarray:
    if not np.isfinite(values).all():
        raise InputError(f"{name} is no finite number at this position, which may lie outside the support")
    return values
