"""Chains: blocks of draws, devices, when to stop, and where to go on."""
