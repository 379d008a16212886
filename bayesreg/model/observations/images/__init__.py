"""A pair of images as an observation."""
