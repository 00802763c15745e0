"""Compiled kernels: arrays in, arrays filled.  `compile` says how they are compiled and kept."""
