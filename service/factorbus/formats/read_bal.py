"""Read a file of bundle adjustment in the large (BAL): cameras with their lenses, points, and what they see.

    cameras points observations
    camera point x y                 an observation each
    nine numbers a camera            rotation vector and translation, of world to camera; f k1 k2
    three numbers a point

Its cameras look along −z, x right and y up, and pixels are from the middle of the image: p = −P/P_z of the point
P = R X + t in the camera, pixel = f (1 + k1 |p|² + k2 |p|⁴) p.  Ours look along z, x right and y down: the pose is
the inverse of F (R, t) with F = diag(1, −1, −1), a pixel (x, −y), and c_x = c_y = 0.  MATH §3.9
"""

import re

import numpy as np

from factorbus.formats.errors import FormatError, refuse_first
from factorbus.formats.graph import GraphFile
from factorbus.proto.arrays import F64, I64
from factorbus.proto.camera import Camera
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

BAL = "bal"
_COUNTS = re.compile(rb"\s*(\d+)[ \t]+(\d+)[ \t]+(\d+)[ \t]*\r?\n\s*\d+[ \t]+\d+[ \t]+\S+[ \t]+\S+[ \t]*\r?\n")
_KIND = "point_seen_bundler"


def is_bal(content: bytes) -> bool:
    """Whether a file begins with three counts on a line, and an observation of four numbers on the next."""
    return _COUNTS.match(content) is not None


def read_bal(file: str, content: bytes) -> GraphFile:
    """Cameras x0, x1, ... with lenses c0, c1, ... of their own, and points l0, l1, ...; pixels have a sigma of 1.

    The first camera is fixed, and the scale, which nothing measures, is held by the distance between that camera and
    the one that is furthest from it: that leaves χ² as it is.  Raises FormatError, which names the file.
    """
    cameras, points, seen, numbers = _numbers(file, content)
    rows = numbers[: 4 * seen].reshape(seen, 4)
    camera, point = rows[:, 0], rows[:, 1]
    for names, count, what in ((camera, cameras, "cameras"), (point, points, "points")):
        wrong = (names < 0) | (names >= count) | (names != np.floor(names))
        wanted = f"one of the {count} {what}"
        refuse_first(file, np.zeros(seen, np.int64), wrong, lambda row, n=names: f"observation of {n[row]:g}", wanted)
    lens = numbers[4 * seen : 4 * seen + 9 * cameras].reshape(cameras, 9)
    refuse_first(
        file,
        np.zeros(cameras, np.int64),
        ~(lens[:, 6] > 0),
        lambda row: f"focal length {lens[row, 6]:g}",
        "more than 0",
    )
    x, l, c = (
        symbol(letter, 0) + np.arange(count) for letter, count in (("x", cameras), ("l", points), ("c", cameras))
    )
    poses = _poses(lens[:, :3], lens[:, 3:6])
    at, of = camera.astype(np.int64), point.astype(np.int64)
    measured = np.zeros((seen, 13))
    measured[:, 0], measured[:, 1], measured[:, 2:] = rows[:, 2], -rows[:, 3], Camera("pinhole", (1, 1, 0, 0)).lens()
    measured[:, 3] = measured[:, 4] = lens[at, 6]
    unit = np.array([1.0, 0.0, 1.0])
    factors = [Factors(_KIND, np.column_stack([x[at], l[of], c[at]]), measured, np.tile(unit, (seen, 1)))]
    notes = [f"{cameras} cameras with lenses of their own, {points} points; a pixel has a sigma of 1; x0 is fixed"]
    away = np.linalg.norm(poses[:, :3] - poses[0, :3], axis=1)
    if away.max() > 0:
        far = int(away.argmax())
        factors.append(Factors("range_between_se3", x[[[0, far]]], away[[[far]]], np.array([[1.0]])))
        notes.append(f"nothing measures the scale: x0 and x{far} are {away[far]:.6g} apart, as the file has them")
    variables = [Variables("se3", x[:1], poses[:1], True)]
    if cameras > 1:
        variables.append(Variables("se3", x[1:], poses[1:]))
    variables += [
        Variables("vector3", c, np.ascontiguousarray(lens[:, 6:])),
        Variables("point3", l, numbers[-3 * points :].reshape(-1, 3)),
    ]
    lines: tuple[I64, ...] = tuple(np.arange(len(group.keys)) for group in factors)
    return GraphFile(file, BAL, Batch(tuple(variables), tuple(factors)), lines, tuple(notes), {}, "keys")


def _numbers(file: str, content: bytes) -> tuple[int, int, int, F64]:
    """The three counts, and all numbers after them."""
    words = content.split()
    cameras, points, seen = (int(word) for word in words[:3])
    wanted = 4 * seen + 9 * cameras + 3 * points
    if min(cameras, points, seen) < 1 or len(words) - 3 != wanted:
        counts = f"{cameras} cameras, {points} points, {seen} observations and {len(words) - 3} numbers after these"
        raise FormatError(
            file, 1, counts, f"one of each at least, and {wanted} numbers: 4 an observation, 9 a camera, 3 a point"
        )
    try:
        numbers = np.array(words[3:], dtype=np.float64)
    except ValueError as error:
        raise FormatError(file, None, str(error), "numbers") from error
    if not np.isfinite(numbers).all():
        raise FormatError(file, None, "a number that is not finite", "finite numbers")
    return cameras, points, seen, numbers


def _poses(turns: F64, ways: F64) -> F64:
    """(m, 7) camera to map, of the rotation vectors and translations of world to camera."""
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    q = np.column_stack([0.5 * np.sinc(angle / (2 * np.pi)) * turns, np.cos(angle / 2)])
    inverse = q * [-1, -1, -1, 1]  # Rᵀ; then Rᵀ F: F is half a turn about x
    x, y, z, w = inverse.T
    u, back = inverse[:, :3], -ways
    t = 2.0 * np.cross(u, back)
    return np.column_stack([back + inverse[:, 3:] * t + np.cross(u, t), w, z, -y, -x])
