"""Codes and places that the kernels and their callers share; those of lenses: `factorbus.solver.lenses.layout`."""

from factorbus.solver.lenses.layout import (
    BEHIND,
    CX,
    CY,
    FISHEYE,
    FU,
    FV,
    GOOD,
    LENS_SIZE,
    LIMIT,
    MORE,
    NOT_FINITE,
    OUTSIDE_IMAGE,
    OUTSIDE_LENS,
    RADIAL,
    RADTAN,
    VERTICAL,
)

__all__ = [
    "BEHIND", "CAMERA", "CX", "CY", "FEATURE", "FISHEYE", "FU", "FV", "GOOD", "LENS_SIZE", "LIMIT", "MORE",
    "NOT_FINITE", "OUTSIDE_IMAGE", "OUTSIDE_LENS", "RADIAL", "RADTAN", "VERTICAL", "Q", "R",
]  # fmt: skip

# Camera state x_v: r (3), q (4, scalar first), v (3), ω (3).
R, Q, CAMERA = 0, 3, 13
FEATURE = 6
