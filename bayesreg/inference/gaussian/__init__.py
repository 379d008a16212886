"""The Gaussian approximation of a posterior about its mode, and the coordinates in which it is N(0, I)."""
