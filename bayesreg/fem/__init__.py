"""Linear elastic finite elements: pure JAX, arrays in and out."""
