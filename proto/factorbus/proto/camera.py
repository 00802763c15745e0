"""A camera as calibration gives it: a lens model's name and its numbers.  The formulas are in `workers/MATH.md` §2."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from types import MappingProxyType

from factorbus.proto.problems import Problem
from factorbus.wording import counted

# The numbers of each model, in this order; from the first in `_OPTIONAL` on they may be left out and are 0.
MODELS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "pinhole": ("fx", "fy", "cx", "cy"),
        "radtan": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
        "fisheye": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
        "radial": ("f", "dx", "dy", "cx", "cy", "k1", "k2"),
    }
)
_LEAST = MappingProxyType({"pinhole": 4, "radtan": 8, "fisheye": 8, "radial": 7})
_CODES = MappingProxyType({"radial": 0, "pinhole": 1, "radtan": 1, "fisheye": 2})
_POSITIVE = frozenset({"fx", "fy", "f", "dx", "dy"})
_MOST_PIXELS = 1 << 20
# As of all numbers: beyond these, squares are lost to rounding, or overflow.
_LARGEST, _SMALLEST = 1e12, 1e-12


def _is_size(number: object) -> bool:
    return isinstance(number, Integral) and not isinstance(number, bool)


class BadCamera(Problem):
    """A camera that cannot be."""

    code = "bad_camera"

    def __init__(self, where: str, seen: object, wanted: str) -> None:
        super().__init__(f"camera: {where} is {seen}; wanted {wanted}", where=where, seen=str(seen), wanted=wanted)


@dataclass(frozen=True, slots=True)
class Camera:
    """A lens model and its numbers, and the size of the image in pixels (0 × 0: not known, any pixel is taken).

    pinhole   fx fy cx cy                        no distortion, or pixels undistorted before
    radtan    fx fy cx cy  k1 k2 p1 p2 [k3]      OpenCV's radial–tangential model (plumb bob)
    fisheye   fx fy cx cy  k1 k2 k3 k4           OpenCV's fisheye model (equidistant)
    radial    f dx dy  cx cy  k1 k2              Civera's and Davison's: f and the pixel's sizes in mm, k1 in mm⁻²,
                                                 k2 in mm⁻⁴; it undistorts in closed form
    Focal lengths fx, fy and the principal point cx, cy are in pixels, the centre of the first pixel is (0, 0).
    Raises BadCamera.
    """

    model: str
    numbers: tuple[float, ...]
    width: int = 0
    height: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.model, str) or self.model not in MODELS:
            raise BadCamera("model", repr(str(self.model)[:64]), f"one of {', '.join(MODELS)}")
        names = MODELS[self.model]
        if isinstance(self.numbers, str | bytes) or not hasattr(self.numbers, "__len__"):
            raise BadCamera(f"numbers of {self.model}", f"{self.numbers!r:.60}", " ".join(names))
        if not _LEAST[self.model] <= len(self.numbers) <= len(names):
            raise BadCamera(f"numbers of {self.model}", counted(len(self.numbers), "number"), " ".join(names))
        for name, number in zip(names, self.numbers, strict=False):
            if isinstance(number, bool) or not isinstance(number, Real) or not math.isfinite(number):
                raise BadCamera(name, f"{number!r:.60}", "a finite number")
            if name in _POSITIVE and number <= 0.0:
                raise BadCamera(name, number, "a number above 0")
            if abs(number) > _LARGEST or (name in _POSITIVE and number < _SMALLEST):
                least = f"from {_SMALLEST:g} " if name in _POSITIVE else ""
                raise BadCamera(name, number, f"a number {least}up to {_LARGEST:g} in magnitude")
        if not (_is_size(self.width) and _is_size(self.height)):
            raise BadCamera("image size", f"{self.width!r:.40} × {self.height!r:.40}", "whole numbers of pixels")
        if not (0 <= self.width <= _MOST_PIXELS and 0 <= self.height <= _MOST_PIXELS):
            raise BadCamera("image size", f"{self.width} × {self.height}", "width × height in pixels, or 0 × 0")
        if (self.width == 0) != (self.height == 0):
            raise BadCamera("image size", f"{self.width} × {self.height}", "both, or 0 × 0 where it is not known")
        # One form for one camera, whatever numbers it was made of.
        object.__setattr__(self, "numbers", tuple(map(float, self.numbers)))

    def number(self, name: str) -> float:
        """One of its numbers by name; 0 where an optional one is left out."""
        names = MODELS[self.model]
        return (*self.numbers, *[0.0] * (len(names) - len(self.numbers)))[names.index(name)]

    def lens(self) -> tuple[float, ...]:
        """The eleven numbers that an observation in a map carries (`factorbus.proto.kinds`):

        code (0 radial, 1 radtan and pinhole, 2 fisheye), f_u f_v c_x c_y (pixels), limit (0: as far as the model is one
        to one), and five of the model: radtan k1 k2 p1 p2 k3, fisheye k1 k2 k3 k4 0, radial d_x d_y k1 k2 0.
        """
        if self.model == "radial":
            f, dx, dy, cx, cy, k1, k2 = self.numbers
            return (0.0, f / dx, f / dy, cx, cy, 0.0, dx, dy, k1, k2, 0.0)
        more = (*self.numbers[4:], *[0.0] * 5)[:5]
        return (float(_CODES[self.model]), *self.numbers[:4], 0.0, *more)
