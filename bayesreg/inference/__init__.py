"""Sampling a posterior, and judging the draws."""
