"""Compiled kernels of inverse-depth features: exact arithmetic, so that every process gets the same bits."""
