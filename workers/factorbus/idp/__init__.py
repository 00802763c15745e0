"""Inverse-depth features: from pixels to y and its covariance.  Mathematics: no bus, clock or thread.

`workers/MATH.md` has the equations.

    seen = see(observations)                      y, and its derivatives by the camera and by the pixel
    minimal.covariance(P, observations, seen)     P with the new features; or rows of it, its upper half, its factors
    independent.covariance(P, A, B, padd)     the same as the 2011 paper has it, and
    classical.covariance(P, A, B, padd)       as it was before
    job.do(payload)                           the job of kind `idp`, in any process

Every covariance comes with the number of multiplications that made it, counted where they are made.
"""

from factorbus.idp.new_features import Seen, jacobians, padd, see
from factorbus.idp.warm import warm_idp

__all__ = ["Seen", "jacobians", "padd", "see", "warm_idp"]
