"""The machine's memory, which bounds what is begun."""

from __future__ import annotations

import os


def memory_of_machine() -> int:
    """Bytes; 64 GiB where the system does not say."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 2**36
