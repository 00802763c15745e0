"""What a lens is, and what may become of a pixel or a point.

A lens is a code and an array of `LENS_SIZE` numbers:

    0 1    f_u f_v       focal length in pixels, along u and along v
    2 3    C_x C_y       principal point, pixels
    4      limit         how far out the model is one to one, in its own radius: RADIAL r_d (mm), RADTAN r, FISHEYE θ
    5 ...                RADIAL: d_x d_y k1 k2;  RADTAN: k1 k2 p1 p2 k3;  FISHEYE: k1 k2 k3 k4
"""

RADIAL, RADTAN, FISHEYE = 0, 1, 2
FU, FV, CX, CY, LIMIT, MORE = 0, 1, 2, 3, 4, 5
LENS_SIZE = 10

# What became of it.
GOOD = 0
NOT_FINITE = 1
OUTSIDE_LENS = 2  # where the lens model is not one to one
OUTSIDE_IMAGE = 3
VERTICAL = 4  # the ray runs along the world's y axis, where azimuth has no meaning
BEHIND = 5  # not in front of the camera
NO_FOCAL_LENGTH = 6  # a focal length that is a variable is not above 0
