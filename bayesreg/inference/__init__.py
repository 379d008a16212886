"""Sampling of a posterior, and diagnostics of the draws."""
