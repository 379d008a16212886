"""Chains on several devices, of one process or of many: each runs its share by itself, without a word to the others.

Processes, one per host, run the same program and know the same after every block of draws.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bayesreg.types import InputError

_AXIS = "chains"
# On a processor so many chains run side by side: what more of them work on leaves the cache (docs/speed.md#groups).
_TOGETHER = 16


def join(coordinator: str | None = None, processes: int | None = None, process: int | None = None) -> None:
    """Run chains with other processes, before anything is computed or BlackJAX imported (which computes).

    See `jax.distributed.initialize`; `bayesreg run` calls it where the configuration has a section `distributed`.

    Parameters
    ----------
    coordinator : str, optional
        Address and port of the first process. Without these three a cluster's own variables (Slurm, Open MPI) tell.
    processes, process : int, optional
        How many there are, and which this is.

    Raises
    ------
    InputError
        If they cannot be joined.
    """
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"the processes cannot be joined ({error}); give distributed.coordinator (host:port of the first), "
            "distributed.processes and distributed.process, or start them by Slurm or Open MPI"
        ) from error


def require_joined(chains: int) -> None:
    """Raise InputError where `join` was not called, or the processes cannot share so many chains."""
    if not jax.distributed.is_initialized():
        raise InputError(
            "the section distributed asks for several processes, which were not joined: use `bayesreg run`, or call "
            "bayesreg.inference.chains.devices.join before anything else of bayesreg is imported"
        )
    devices_for(chains)


def is_first() -> bool:
    """Whether this process is the one that speaks and writes for all."""
    return jax.process_index() == 0


def wait(place: str) -> None:
    """Until all processes have come to a place of that name."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(place)


def from_first(tree: Any) -> Any:
    """Arrays as the first process has them."""
    return multihost_utils.broadcast_one_to_all(tree) if jax.process_count() > 1 else tree


def on_host(tree: Any) -> Any:
    """Arrays as several processes can all hand them to their devices; left as they are where there is one."""
    return jax.tree.map(np.asarray, tree) if jax.process_count() > 1 else tree


def gather(tree: Any) -> Any:
    """Arrays that are spread over the devices of several processes, whole on each."""
    return multihost_utils.process_allgather(tree, tiled=True) if jax.process_count() > 1 else tree


def devices_for(chains: int) -> Mesh | None:
    """The most devices, as many of each process, that can have equal shares of so many chains; None if that is one.

    Raises
    ------
    InputError
        If not even one of each process can, or one process has more devices than another.
    """
    processes, every = jax.process_count(), jax.devices()
    if chains % processes:
        raise InputError(f"{chains} chains cannot be shared by {processes} processes; let sampler.chains be a multiple")
    own = [[device for device in every if device.process_index == process] for process in range(processes)]
    if len(set(map(len, own))) > 1:
        raise InputError(f"processes must have equally many devices; they have {', '.join(str(len(d)) for d in own)}")
    count = max(n for n in range(1, len(own[0]) + 1) if chains % (n * processes) == 0)
    chosen = [device for devices in own for device in devices[:count]]
    return Mesh(np.array(chosen), (_AXIS,)) if len(chosen) > 1 else None


def share(tree: Any, devices: Mesh | None) -> Any:
    """Arrays whose leading axis is that of the chains, on these devices, as a block of draws leaves them.

    The first block would otherwise be compiled for other places than all after it.
    """
    if devices is None or jax.process_count() > 1:
        return tree
    return jax.device_put(tree, NamedSharding(devices, PartitionSpec(_AXIS)))


def side_by_side(chain: Callable, devices: Mesh | None) -> Callable:
    """A function of one chain as one of many, whose leading axis is that of the chains, on these devices.

    What the function closes over is on each device.
    """
    many = partial(_in_groups, chain)
    if devices is None:
        return many
    # Not told apart: values that vary with the device, and those that do not, such as zeros that a sum begins with.
    share = PartitionSpec(_AXIS)
    return jax.shard_map(many, mesh=devices, in_specs=share, out_specs=share, check_vma=False)


def _in_groups(chain: Callable, *each: Any) -> Any:
    """One group after the other; all together on a GPU, and where they are few or no size of a group divides them."""
    chains = len(jax.tree.leaves(each)[0])
    sizes = range(_TOGETHER, _TOGETHER // 2 - 1, -1) if jax.default_backend() == "cpu" else ()
    size = next((size for size in sizes if chains % size == 0), chains)
    if size == chains:
        return jax.vmap(chain)(*each)
    return jax.lax.map(lambda one: chain(*one), each, batch_size=size)
