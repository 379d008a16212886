"""Running chains: start points, blocks of draws, devices, stop rule, checkpoints and progress."""
