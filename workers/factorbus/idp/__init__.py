"""Inverse-depth features: from pixels to y and its covariance.  Pure mathematics: no bus, clock, thread or file.

`workers/MATH.md` has the equations.

    seen = see(sighting)                      y, and its derivatives by the camera and by the pixel
    minimal.rows(sighting, seen)              the new rows of P, or `half`, or `factored`
    independent.covariance(P, A, B, padd)     the same as the 2011 paper has it, and
    classical.covariance(P, A, B, padd)       as it was before

Every covariance comes with the number of multiplications that made it, counted where they are made.
"""

from factorbus.idp.sight import Seen, jacobians, padd, see
from factorbus.idp.warm import warm

__all__ = ["Seen", "jacobians", "padd", "see", "warm"]
