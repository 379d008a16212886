"""Pairs of images with a known truth, and what a mesh does to stiffness."""
