"""The benchmarks compile with the settings of the command line, set before anything imports JAX."""

from bayesreg.compilation import compile_quickly

compile_quickly()
