"""The Gaussian that a posterior looks like about its mode, and coordinates in which it is N(0, I)."""
