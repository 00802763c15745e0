"""What a sensor measures where something of it is a variable: its mount, bias, scale, lever arm, clock, lens.

Each is said by a keyword whose value is the key of that variable, and makes another kind of the same measurement:
`bias="b0"` of a range is `range_se2_bias` (`factorbus.proto.derived_kinds`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from factorbus.client.arguments import all_finite, as_numbers, checked_row
from factorbus.client.certainty import Certainty, check_names, inverted, transform_certainty
from factorbus.client.key_numbers import Key, key_number
from factorbus.client.lever_arm import transform_se2, transform_se3
from factorbus.proto.arrays import F64
from factorbus.proto.derived_kinds import LENSES
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.problems import BadLoss, BadOption, BadShape
from factorbus.proto.symbols import format_symbol

_KEYWORDS = {"arm": "lever"}  # what a modifier is called here, where its name is another
_LETTERLESS = 1 << 56  # keys with a letter are not below
# In the order that names of kinds have them in.
MODIFIERS = ("mount", "bias", "scale", "frame", "arm", "offset", *LENSES)


class Clock(Certainty, total=False):
    """The same of what is measured by a sensor with a clock of its own.

    offset: the key of a `vector1`, how many seconds after the time of the pose it has measured.
    twist: how the robot moves then, in its own frame: vx vy (m/s), omega (rad/s); in space vx vy vz, omega about x y z.
    """

    offset: Key | None
    twist: ArrayLike | None


class SensorCertainty(Clock, total=False):
    """The same of what a sensor measures that is not in the robot's middle, or is not exact.

    mount: the key of a pose in the robot's frame, where the sensor is on it: a variable, to be found out or fixed.
    bias: of a range, the key of a `vector1` that is added to the true distance, metres.
    """

    mount: Key | None
    bias: Key | None


class CameraCertainty(SensorCertainty, total=False):
    """The same of a camera, numbers of whose lens are a variable: the key of one of these, to be found out or fixed.

    focal: a `vector1`, the focal length f along u, pixels; that along v is to it as the camera says.
    bundler: a `vector3`, f (of u and v) k1 k2, as files of bundle adjustment have it; the rest is the camera's.
    intrinsics: a `vector9`, fx fy cx cy k1 k2 p1 p2 k3 of a pinhole or radtan camera.
    """

    focal: Key | None
    bundler: Key | None
    intrinsics: Key | None


class OdometryCertainty(Certainty, total=False):
    """The same of a sensor that has measured its own way.

    mount: where it is on the robot: a pose, or the key of one that is to be found out.
    scale: the key of a `vector1` that the measured translation is to be multiplied by.
    """

    mount: Key | ArrayLike | None
    scale: Key | None


class RangeCertainty(Certainty, total=False):
    """The same of a distance between poses.  bias: as in `SensorCertainty`."""

    bias: Key | None


class AntennaCertainty(Clock, total=False):
    """The same of where an antenna is.

    lever: where it is on the robot, metres; or the key of a `vector2`, in space a `vector3`, that is to be found out.
    frame: the key of a pose, that of the map in the frame in which this is measured: to be found out, or fixed.
    """

    lever: Key | ArrayLike
    frame: Key | None


class GnssCertainty(AntennaCertainty, total=False):
    """The same of a receiver.  covariance (3, 3): of east, north, up, m², in place of sigmas or information."""

    covariance: ArrayLike | None


class Measured(NamedTuple):
    """A factor as `Draft.factor` takes it."""

    kind: str
    keys: tuple[Key, ...]
    measured: F64
    certainty: Certainty


def sensed(
    kind: str, keys: tuple[Key, ...], measured: ArrayLike, certainty: Mapping[str, Any], of: type = SensorCertainty
) -> Measured:
    """What is measured where more of the sensor may be a variable.  Raises BadShape, BadSymbol, BadInformation.

    certainty: with the keys of further variables, by keyword.  of: the keywords that there are.
    """
    check_names(" ".join([kind, *(format_symbol(key_number(key)) for key in keys)]), certainty, of)
    given = {name: key_number(cast("Key", certainty[name])) for name in MODIFIERS if certainty.get(name) is not None}
    rest = {name: value for name, value in certainty.items() if name not in (*MODIFIERS, "twist")}
    kind, row = _together(kind, tuple(given)), as_numbers(f"{kind}: measured", measured)
    twist = certainty.get("twist")
    if ("offset" in given) != (twist is not None):
        seen = "offset without twist" if twist is None else "twist without offset"
        raise BadShape(kind, seen, "both: the key of the clock's offset, and how the robot moves in its own frame")
    if twist is not None:
        row = as_numbers(kind, [*row.ravel(), *_twist(f"{kind}: twist", twist, 3 if "se2" in kind else 6)])
    return Measured(kind, (*keys, *given.values()), row, cast("Certainty", rest))


def _together(kind: str, given: tuple[str, ...]) -> str:
    """The kind with these further variables.  Raises BadOption: there is none with all of them."""
    if (name := "_".join([kind, *given])) in FACTOR_KINDS:
        return name
    each = [of.modifiers for of in FACTOR_KINDS.values() if of.base == kind]
    listed = ", ".join(" with ".join(_KEYWORDS.get(word, word) for word in words) for words in each)
    seen = " and ".join(f"{_KEYWORDS.get(word, word)}=" for word in given)
    wanted = f"one of: {listed}; or none. A factor of your own may have all (factorbus.client.expressions)"
    raise BadOption(kind, f"the keys of {seen}, which do not go together", wanted)


def odometry(kind: str, keys: tuple[Key, Key], measured: ArrayLike, certainty: Mapping[str, Any]) -> Measured:
    """A relative pose; kind: `between_se2` or `between_se3`.  Raises as `sensed`."""
    where, mount = " ".join([kind, *(format_symbol(key_number(key)) for key in keys)]), certainty.get("mount")
    _check_scale(where, certainty.get("loss"), certainty.get("scale"))
    if mount is None or isinstance(mount, str | int):
        return sensed(kind, keys, measured, certainty, OdometryCertainty)
    if certainty.get("scale") is not None:
        raise BadShape(where, "a scale and the mount as numbers", "one of the two: the scale is of the robot's own way")
    size, dim = (3, 3) if kind == "between_se2" else (7, 6)
    z, there = checked_row(f"{where}: measured", measured, size), checked_row(f"{where}: mount", mount, size)
    z, A = transform_se2(z, there) if size == 3 else transform_se3(where, z, there)
    rest = {name: value for name, value in certainty.items() if name not in ("mount", "scale")}
    return Measured(kind, keys, z, transform_certainty(where, dim, cast("Certainty", rest), A, kind))


def positioned(kind: str, key: Key, measured: ArrayLike, certainty: Mapping[str, Any]) -> Measured:
    """Where an antenna is; kind: `position_se2` or `position_se3`.  Raises as `sensed`."""
    size = 2 if kind == "position_se2" else 3
    check_names(f"{kind} {format_symbol(key_number(key))}", certainty, AntennaCertainty)
    given = {name: value for name, value in certainty.items() if name != "lever"}
    lever, row = certainty.get("lever", np.zeros(size)), checked_row("measured", measured, size)
    if isinstance(lever, str | int):
        return sensed(kind, (key,), row, {**given, "arm": lever}, _WithArm)
    return sensed(kind, (key,), [*row, *checked_row("lever", lever, size)], given, AntennaCertainty)


def with_information(key: Key, certainty: Mapping[str, Any]) -> Mapping[str, Any]:
    """The certainty with an information where a covariance is given.  Raises BadShape, BadInformation."""
    where = f"gnss {format_symbol(key_number(key))}"
    check_names(where, certainty, GnssCertainty)
    rest = {name: value for name, value in certainty.items() if name != "covariance"}
    if certainty.get("covariance") is None:
        sigmas = certainty.get("sigmas")
        shape = (3,) if sigmas is None else as_numbers(f"{where}: sigmas", sigmas).shape
        if shape != (3,):
            raise BadShape(f"{where}: sigmas", f"shape {shape}", "(3,): of east, north, up (metres)")
        return rest
    return {**rest, **inverted(where, certainty["covariance"], rest)}


def _check_scale(where: str, loss: object, scale: object) -> None:
    """A number beside a loss without a scale is that of the loss, not the key of a variable.  Raises BadLoss."""
    if isinstance(loss, str) and isinstance(scale, (int, float, np.number)) and abs(scale) < _LETTERLESS:
        wanted = f'loss=("{loss}", {scale}); scale= is the key of a variable, such as "s0"'
        raise BadLoss(where, f"loss={loss!r} beside scale={scale!r}", wanted)


class _WithArm(AntennaCertainty, total=False):
    arm: Key


def _twist(where: str, twist: ArrayLike, count: int) -> F64:
    moves = all_finite(where, as_numbers(where, twist))
    if moves.shape != (count,):
        wanted = "vx vy (m/s), omega (rad/s)" if count == 3 else "vx vy vz (m/s), omega about x y z (rad/s)"
        raise BadShape(where, f"shape {moves.shape}", f"({count},): {wanted}")
    return moves
