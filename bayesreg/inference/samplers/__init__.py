"""The samplers, with one file for each family."""
