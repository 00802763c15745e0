"""Codes and places that the kernels and their callers share.

A lens is a code and an array of `LENS_SIZE` numbers:

    0 1    f_u f_v       focal length in pixels, along u and along v
    2 3    C_x C_y       principal point, pixels
    4      limit         how far out the model is one to one, in its own radius: RADIAL r_d (mm), RADTAN r, FISHEYE θ
    5 ...                RADIAL: d_x d_y k1 k2;  RADTAN: k1 k2 p1 p2 k3;  FISHEYE: k1 k2 k3 k4
"""

RADIAL, RADTAN, FISHEYE = 0, 1, 2
FU, FV, CX, CY, LIMIT, MORE = 0, 1, 2, 3, 4, 5
LENS_SIZE = 10

# Camera state x_v: r (3), q (4, scalar first), v (3), ω (3).
R, Q, CAMERA = 0, 3, 13
FEATURE = 6

# What became of a pixel or a point.
GOOD = 0
NOT_FINITE = 1
OUTSIDE_LENS = 2  # where the lens model is not one to one
OUTSIDE_IMAGE = 3
VERTICAL = 4  # the ray runs along the world's y axis, where azimuth has no meaning
BEHIND = 5  # not in front of the camera
