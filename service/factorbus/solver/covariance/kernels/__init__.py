"""Compiled kernels of covariances; they read the tree of cliques and know nothing of how it is made."""
