"""From variables to lines and points that can be drawn, in the plane or in space."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Variables

POSITION = {"se2": 2, "point2": 2, "se3": 3, "point3": 3, "sim3": 3}
_LETTER_BITS = 56
_FLAT = 0.1  # a track whose third extent is below that share of its first is drawn in the plane
_LINE = 1e-3  # and one whose second extent is below that share lies on a line, which many planes have
_NARROWEST = 0.3  # a picture's shorter side over its longer one, at least: a straight drive stays legible


@dataclass(frozen=True, slots=True)
class Track:
    """Positions of poses: keys (n,) in order, places (n, 2 or 3)."""

    keys: I64
    places: F64


def track_of(variables: Sequence[Variables]) -> Track:
    """The poses of `variables` that have a value, by key; places have three columns if any pose is in space."""
    return _positions(variables, ("se2", "se3", "sim3"))


def points_of(variables: Sequence[Variables]) -> Track:
    """The points of `variables` likewise."""
    return _positions(variables, ("point2", "point3"))


def feature_rays(variables: Sequence[Variables], horizon_m: float = 50.0) -> Track:
    """Inverse-depth features as rays: places (n, 2, 3), from the camera of their first observation to where they are
    estimated to be, and no further than the horizon.

    A value is x y z θ φ ρ; the ray points along (cos φ sin θ, −sin φ, cos φ cos θ), 1/ρ metres (`workers/MATH.md`).
    """
    mine = [group for group in variables if group.kind == "idp" and group.values is not None]
    keys = np.concatenate([np.empty(0, np.int64), *(group.keys for group in mine)])
    rows = np.concatenate([np.empty((0, 6)), *(group.values for group in mine if group.values is not None)])
    theta, phi, rho = rows[:, 3], rows[:, 4], np.maximum(rows[:, 5], 1.0 / horizon_m)
    ray = np.stack([np.cos(phi) * np.sin(theta), -np.sin(phi), np.cos(phi) * np.cos(theta)], axis=1)
    return Track(keys, np.stack([rows[:, :3], rows[:, :3] + ray / rho[:, None]], axis=1))


def line_of(track: Track) -> F64:
    """The track as one line (n + gaps, 2 or 3), with NaN between robots (letters of the keys)."""
    changes = np.flatnonzero(np.diff(track.keys >> _LETTER_BITS)) + 1
    return np.insert(track.places, changes, np.nan, axis=0)


def segments_of(track: Track, pairs: I64) -> F64:
    """Segments (m, 2, 2 or 3) between poses of the track; pairs with a pose that is not in it are left out."""
    if not len(track.keys):
        return np.empty((0, 2, 2))
    at = np.minimum(np.searchsorted(track.keys, pairs), len(track.keys) - 1)
    return track.places[at[(track.keys[at] == pairs).all(axis=1)]]


@dataclass(frozen=True, slots=True)
class View:
    """How positions are drawn: in space as they are, or turned by `axes` (2, d) into the plane."""

    in_space: bool
    axes: F64
    labels: tuple[str, ...]

    def __call__(self, places: F64) -> F64:
        """Positions (..., 2 or 3) as they are drawn (..., 2 or 3)."""
        padded = np.zeros((*places.shape[:-1], 3))
        padded[..., : places.shape[-1]] = places
        return padded if self.in_space else padded @ self.axes.T


def view_of(places: F64) -> View:
    """In space when the places (n, d) fill it, else the plane in which they lie: x and y, or the two widest axes.

    A line is drawn in x and y too, or in x and z where it is upright.
    """
    ground = View(False, np.eye(3)[:2], ("x (m)", "y (m)"))
    if places.shape[1] == 2 or len(places) < 3:
        return ground
    _, spread, axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)
    if spread[1] <= _LINE * spread[0]:
        return ground if abs(axes[0, 2]) < 0.9 else View(False, np.eye(3)[[0, 2]], ("x (m)", "z (m)"))
    if spread[2] > _FLAT * spread[0]:
        return View(True, np.eye(3), ("x (m)", "y (m)", "z (m)"))
    if abs(axes[2, 2]) > 0.9:
        return ground
    return View(False, axes[:2], ("widest axis (m)", "second axis (m)"))


def limits(kept: F64, tried: F64, *, margin: float = 0.04, beyond: float = 0.12) -> F64:
    """Bounds (2, d) of a picture that has all of `kept` in it, and of `tried` what is not too far out.

    margin: added on each side; beyond: how far `tried` may widen the picture on each side; both in parts of its size.
    In the plane no side is shorter than `_NARROWEST` of the longest.
    """
    low, high = np.nanmin(kept, axis=0), np.nanmax(kept, axis=0)
    size = max(float((high - low).max()), 1e-9)
    if len(tried):
        low = np.maximum(np.minimum(low, np.nanmin(tried, axis=0)), low - beyond * size)
        high = np.minimum(np.maximum(high, np.nanmax(tried, axis=0)), high + beyond * size)
    least = _NARROWEST * float((high - low).max()) if len(low) == 2 else 0.0
    missing = np.maximum(least - (high - low), 0.0) / 2
    return np.stack([low - missing - margin * size, high + missing + margin * size])


def _positions(variables: Sequence[Variables], kinds: tuple[str, ...]) -> Track:
    mine = [group for group in variables if group.kind in kinds and group.values is not None]
    width = max((POSITION[group.kind] for group in mine), default=2)
    keys, places = [np.empty(0, np.int64)], [np.empty((0, width))]
    for group in mine:
        if group.values is not None:
            size = POSITION[group.kind]
            keys.append(np.asarray(group.keys))
            places.append(np.pad(group.values[:, :size], ((0, 0), (0, width - size))))
    keys, places = np.concatenate(keys), np.concatenate(places)
    order = np.argsort(keys, kind="stable")
    return Track(keys[order], places[order])
