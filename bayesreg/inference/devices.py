"""Chains on several devices: each runs its share by itself, without a word to the others."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

_AXIS = "chains"


def devices_for(chains: int) -> Mesh | None:
    """The most devices that can have equal shares of so many chains; None if that is one."""
    devices = jax.local_devices()
    count = max(n for n in range(1, len(devices) + 1) if chains % n == 0)
    return Mesh(np.array(devices[:count]), (_AXIS,)) if count > 1 else None


def side_by_side(chain: Callable, devices: Mesh | None) -> Callable:
    """A function of one chain as one of many, whose leading axis is that of the chains, on these devices.

    What the function closes over is on each device.
    """
    many = jax.vmap(chain)
    if devices is None:
        return many
    # Not told apart: values that vary with the device, and those that do not, such as zeros that a sum begins with.
    share = PartitionSpec(_AXIS)
    return jax.shard_map(many, mesh=devices, in_specs=share, out_specs=share, check_vma=False)
