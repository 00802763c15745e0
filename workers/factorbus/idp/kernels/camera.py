"""A camera as kernels have it."""

from typing import NamedTuple

from factorbus.idp.kernels.compile import F64, types


class CameraModel(NamedTuple):
    """A lens and the size of the image.

    model: a code of `factorbus.solver.lenses.layout`   lens (10,): its numbers, as there
    width, height: of the image in pixels; 0: any size
    """

    model: int
    lens: F64
    width: float
    height: float


CAMERA_MODEL = types.NamedTuple((types.int64, types.float64[::1], types.float64, types.float64), CameraModel)
