"""Covariances of a map's variables, and what they tell: from R on its pattern, never from an inverse.  MATH §10."""
