"""Samplers, one file a family."""
