"""Sparse Cholesky in fronts: minimum degree, symbolic analysis, multifrontal factorization, triangular solves."""
