"""Draws: ArviZ, what they say of convergence, and what follows from them."""
