"""The records of JRL files (JSON Robot Log), of SLAM with several robots.

    {"name": text, "robots": [97, ...],
     "measurements":   {"a": [{"stamp": t, "measurements": [{"type": ..., ...}, ...]}, ...], ...},
     "initialization": {"a": [{"type": "Pose2", "key": k, "x": ..., "y": ..., "theta": ...}, ...], ...},
     "groundtruth":    as the initialization,
     "potential_outlier_factors", "outlier_factors":   {"a": [[entry, measurement], ...], ...}}   or `outlier_labels`

A robot is a letter, a key is a symbol as GTSAM packs it.  Measurements are {"type", "key", "prior", "covariance"} or
{"type", "key1", "key2", "measurement", "covariance"}.  Values are objects; of 3D poses with "translation" x y z and
"rotation" qw qx qy qz.  A covariance is a whole matrix row by row, in radians, in the order of GTSAM's tangent spaces:
of 3D poses the rotation comes first.  A stamp is a whole number from 0, here in nanoseconds.

What the documents of JRL and its programs write differently is read in both ways: robots as letters or their codes,
values as an array or by key, a number as itself or as {"type": "Scalar", "value": ...}, a direction as three numbers or
as {"type": "Unit3", "i": ..., "j": ..., "k": ...}, and the whole in JSON or in CBOR (`cbor`).
"""

from factorbus.formats.json_parts import Part

JRL = "jrl"

VALUES = {"Pose2": "se2", "Pose3": "se3", "Point2": "point2", "Point3": "point3"}
PRIORS = {f"PriorFactor{name}": f"prior_{kind}" for name, kind in VALUES.items()}
FACTORS = {
    **PRIORS,
    "BetweenFactorPose2": "between_se2",
    "BetweenFactorPose3": "between_se3",
    "RangeFactorPose2": "range_between_se2",
    "RangeFactorPose3": "range_between_se3",
    "RangeFactor2D": "range_se2",
    "RangeFactor3D": "range_se3",
    "BearingRangeFactor2D": "bearing_range_se2",
    "BearingRangeFactor3D": "landmark_se3",  # as `bearing_ranges` has it
}
BEARING_RANGE_3D = "BearingRangeFactor3D"
SCALAR, BEARING_RANGE, ROT2, UNIT3 = "Scalar", "BearingRange", "Rot2", "Unit3"
# What is measured, by the name of the factor.
_MEASURED = {name: name.removeprefix("PriorFactor").removeprefix("BetweenFactor") for name in FACTORS}
_MEASURED |= {name: SCALAR for name in FACTORS if name.startswith("RangeFactor")}
_MEASURED |= {"BearingRangeFactor2D": BEARING_RANGE, BEARING_RANGE_3D: BEARING_RANGE}
_BEARINGS = {BEARING_RANGE_3D: UNIT3}

# Where the rows of our residual, x y z and a rotation, are in GTSAM's tangent space of 3D poses; and the other way.
GTSAM_ORDER = (3, 4, 5, 0, 1, 2)


def measured_numbers(name: str, part: Part) -> list[float]:
    """What a factor of that name has measured, in our order.  Raises FormatError."""
    return value_numbers(_MEASURED[name], part, _BEARINGS.get(name, ROT2))


def value_numbers(name: str, part: Part, bearing: str = ROT2) -> list[float]:
    """The numbers of a value of that name, in our order; bearing: what one is that it has.  Raises FormatError."""
    if name in (SCALAR, ROT2) and not isinstance(part.value, dict):
        return [part.number()]
    if name == UNIT3 and not isinstance(part.value, dict):
        return part.numbers(3)
    told = part.find("type")
    if told is not None and told.text() != name:
        raise told.refused(f'"{name}"')
    if name == "Pose3":
        w, x, y, z = part.member("rotation").numbers(4)
        return [*part.member("translation").numbers(3), x, y, z, w]
    if name == BEARING_RANGE:
        return value_numbers(bearing, part.member("bearing")) + value_numbers(SCALAR, part.member("range"))
    return [part.member(field).number() for field in _FIELDS[name]]


def as_value(name: str, numbers: list[float]) -> dict[str, object]:
    """The value of that name which has these numbers."""
    if name == "Pose3":
        *place, x, y, z, w = numbers
        return {"type": name, "translation": place, "rotation": [w, x, y, z]}
    if name == BEARING_RANGE:
        bearing = as_value(ROT2 if len(numbers) == 2 else UNIT3, numbers[:-1])
        return {"type": name, "bearing": bearing, "range": as_value(SCALAR, numbers[-1:])}
    return {"type": name, **dict(zip(_FIELDS[name], numbers, strict=True))}


def as_measured(name: str, numbers: list[float]) -> dict[str, object]:
    """The value that a factor of that name has for these numbers."""
    return as_value(_MEASURED[name], numbers)


_FIELDS = {
    "Pose2": ("x", "y", "theta"),
    "Point2": ("x", "y"),
    "Point3": ("x", "y", "z"),
    SCALAR: ("value",),
    ROT2: ("theta",),
    UNIT3: ("i", "j", "k"),
}
