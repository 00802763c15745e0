"""Latitude, longitude and height as metres east, north and up of an origin, on the ellipsoid of WGS 84.

With φ latitude, λ longitude, h height above the ellipsoid, a its larger half axis and e² its squared eccentricity,

    N = a / √(1 − e² sin² φ),   X = (N + h) cos φ cos λ,   Y = (N + h) cos φ sin λ,   Z = (N (1 − e²) + h) sin φ   (1)

are coordinates that turn with the Earth (ECEF), and east, north and up of (φ₀, λ₀, h₀) are R (X − X₀) with

    R = [ −sin λ₀  cos λ₀  0 ;  −sin φ₀ cos λ₀  −sin φ₀ sin λ₀  cos φ₀ ;  cos φ₀ cos λ₀  cos φ₀ sin λ₀  sin φ₀ ]   (2)
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from factorbus.client.arguments import all_finite, as_numbers
from factorbus.proto.arrays import F64
from factorbus.proto.problems import BadOption, BadShape

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
MOST_LONGITUDE = 360.0  # degrees: from -180 to 180 and from 0 to 360 are both in use
_E2 = FLATTENING * (2.0 - FLATTENING)
_NEWTON = 6


def enu(place: ArrayLike, origin: ArrayLike, where: str = "") -> F64:
    """Metres (3,) east, north and up of `origin`, of a place; both latitude, longitude (degrees), height (metres).

    Heights are above the ellipsoid, as receivers report them beside those above sea level.  where: before what an error
    says.  Raises BadShape, BadOption, NotFiniteNumbers.
    """
    return _enu(_checked(f"{where}place", place), _checked(f"{where}origin", origin))


def geodetic(east_north_up: ArrayLike, origin: ArrayLike) -> F64:
    """Latitude, longitude (degrees), height (metres) of metres (3,) east, north and up of `origin`: `enu` backwards.

    Newton's steps on (1) and (2); near the ground three are enough to the last digit.  Raises BadShape, BadOption,
    NotFiniteNumbers.
    """
    here, wanted = _checked("origin", origin), all_finite("east_north_up", as_numbers("east_north_up", east_north_up))
    if wanted.shape != (3,):
        raise BadShape("east_north_up", f"shape {wanted.shape}", "(3,): metres")
    place = here.copy()
    for _ in range(_NEWTON):
        left = _axes(place) @ (_axes(here).T @ (wanted - _enu(place, here)))
        s = np.sin(np.radians(place[0]))
        N = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * s * s)
        meridian = N * (1.0 - _E2) / (1.0 - _E2 * s * s)
        place[0] += np.degrees(left[1] / (meridian + place[2]))
        place[1] += np.degrees(left[0] / ((N + place[2]) * np.cos(np.radians(place[0]))))
        place[2] += left[2]
    return _named(place)


def _named(place: F64) -> F64:
    """The same place by angles that `enu` takes: beyond a pole by the meridian there, beyond a full turn from -180 to
    180."""
    latitude, longitude = math.remainder(place[0], 360.0), place[1]
    if abs(latitude) > 90.0:
        latitude, longitude = math.copysign(180.0, latitude) - latitude, longitude + 180.0
    if abs(longitude) > MOST_LONGITUDE:
        longitude = math.remainder(longitude, 360.0)
    return np.array([latitude, longitude, place[2]])


def ecef(place: ArrayLike) -> F64:
    """X Y Z (3,), metres, of latitude, longitude (degrees), height (metres).  (1)"""
    return _ecef(_checked("place", place))


def _enu(there: F64, here: F64) -> F64:
    return _axes(here) @ (_ecef(there) - _ecef(here))


def _ecef(place: F64) -> F64:
    (s, sin_east), (c, cos_east), height = *_sines(place), place[2]
    N = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * s * s)
    return np.array([(N + height) * c * cos_east, (N + height) * c * sin_east, (N * (1.0 - _E2) + height) * s])


def _axes(origin: F64) -> F64:
    """R, whose rows point east, north and up in X Y Z.  (2)"""
    (s, sin_east), (c, cos_east) = _sines(origin)
    return np.array(
        [
            [-sin_east, cos_east, 0.0],
            [-s * cos_east, -s * sin_east, c],
            [c * cos_east, c * sin_east, s],
        ]
    )


def _sines(place: F64) -> tuple[F64, F64]:
    angles = np.radians(place[:2])
    return np.sin(angles), np.cos(angles)


def _checked(what: str, place: ArrayLike) -> F64:
    """Raises BadShape, BadOption, NotFiniteNumbers."""
    given = all_finite(what, as_numbers(what, place))
    if given.shape != (3,):
        raise BadShape(what, f"shape {given.shape}", "(3,): latitude, longitude (degrees), height (metres)")
    for name, angle, most in (("latitude", given[0], 90.0), ("longitude", given[1], MOST_LONGITUDE)):
        if abs(angle) > most:
            raise BadOption(what, f"{name} {angle:g}", f"-{most:g} to {most:g} degrees: latitude, longitude, height")
    return given
