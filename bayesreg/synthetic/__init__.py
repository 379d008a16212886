"""Synthetic pairs of images with a known deformation and stiffness."""
