"""Λ in blocks, its elimination order, its Cholesky factor, and whether every variable is held."""
