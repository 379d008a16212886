"""Compiled as the command line has it, before anything imports JAX."""

from bayesreg.compilation import compile_quickly

compile_quickly()
