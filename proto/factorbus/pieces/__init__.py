"""What is known of several variables together, in pieces of one variable or two that a map takes in.  NumPy alone.

A front end that sends a linear factor of many variables cuts it up here, and so does the solver with its marginals.
"""

from factorbus.pieces.cut import MOST, Pieces, as_pieces, cut, tangent_dims

__all__ = ["MOST", "Pieces", "as_pieces", "cut", "tangent_dims"]
