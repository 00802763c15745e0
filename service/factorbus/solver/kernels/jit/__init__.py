"""How kernels are compiled and kept, and what all of them use: tables of arrays, atomics, vectors, bit sets."""
