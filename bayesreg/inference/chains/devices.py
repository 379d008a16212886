"""Chains on several devices of one process: each device runs its share, without communication between devices."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

_AXIS = "chains"
# The greatest number of chains that a CPU runs at once: the arrays of more chains exceed its cache
# (docs/speed.md#groups).
_TOGETHER = 16


def devices_for(chains: int) -> Mesh | None:
    """Choose the most devices that can have equal shares of the chains; return None if that is one device."""
    devices = jax.devices()
    count = max(n for n in range(1, len(devices) + 1) if chains % n == 0)
    return Mesh(np.array(devices[:count]), (_AXIS,)) if count > 1 else None


def share(tree: Any, devices: Mesh | None) -> Any:
    """Distribute arrays, whose leading axis is the chains, among devices.

    A block of draws returns its arrays distributed in this way. Without it, JAX would compile the first block for
    another distribution than the later ones.
    """
    if devices is None:
        return tree
    return jax.device_put(tree, NamedSharding(devices, PartitionSpec(_AXIS)))


def side_by_side(chain: Callable, devices: Mesh | None) -> Callable:
    """Make a function of many chains (chains as the leading axis) from a function of one chain, on these devices.

    The arrays that the function closes over are copied to each device.
    """
    grouped = partial(_in_groups, chain)
    if devices is None:
        return grouped
    # JAX would otherwise require a distinction between values that vary with the device and values that do not, such as
    # the zeros with which a sum begins.
    share = PartitionSpec(_AXIS)
    return jax.shard_map(grouped, mesh=devices, in_specs=share, out_specs=share, check_vma=False)


def _in_groups(chain: Callable, *each: Any) -> Any:
    """Run the chains in groups, one group after the other.

    All chains run at once on a GPU, if there are few of them, or if no allowed size of a group divides their number.
    """
    chains = len(jax.tree.leaves(each)[0])
    sizes = range(_TOGETHER, _TOGETHER // 2 - 1, -1) if jax.default_backend() == "cpu" else ()
    size = next((size for size in sizes if chains % size == 0), chains)
    if size == chains:
        return jax.vmap(chain)(*each)
    return jax.lax.map(lambda arguments: chain(*arguments), each, batch_size=size)
