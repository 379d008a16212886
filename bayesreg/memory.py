"""Measure the memory of the machine, which limits the size of a run."""

from __future__ import annotations

import os


def memory_of_machine() -> int:
    """Return the memory of the machine in bytes; 64 GiB if the system does not report it."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 2**36
