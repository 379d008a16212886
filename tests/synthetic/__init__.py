"""Tests of synthetic pairs."""
