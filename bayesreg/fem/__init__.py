"""Linear elastic finite elements in JAX and NumPy; functions take and return arrays."""
