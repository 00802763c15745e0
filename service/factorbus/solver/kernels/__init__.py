"""Compiled kernels: arrays in, arrays filled.  `_jit` says how they are compiled and kept."""
