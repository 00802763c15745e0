"""Compiled kernels of inverse-depth features: exact arithmetic, so that whoever computes gets the same bits."""
