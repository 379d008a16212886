"""Chains on several devices of one process: each device runs its share, without a word to the others."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

_AXIS = "chains"
# On a processor so many chains run side by side: what more of them work on leaves the cache (docs/speed.md#groups).
_TOGETHER = 16


def devices_for(chains: int) -> Mesh | None:
    """The most devices that can have equal shares of so many chains; None if that is one."""
    every = jax.devices()
    count = max(n for n in range(1, len(every) + 1) if chains % n == 0)
    return Mesh(np.array(every[:count]), (_AXIS,)) if count > 1 else None


def share(tree: Any, devices: Mesh | None) -> Any:
    """Arrays whose leading axis is that of the chains, on these devices, as a block of draws leaves them.

    The first block would otherwise be compiled for other places than all after it.
    """
    if devices is None:
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
