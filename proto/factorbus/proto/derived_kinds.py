"""Kinds of factors that another one becomes with further variables: a sensor's place, bias, clock, lens.

`range_se2_bias` is `range_se2` with a bias, `position_se3_frame_arm` is `position_se3` in another frame with a lever
arm.  Each modifier appends a variable and may change what is measured; the solver evaluates all of them with the
residual of the base kind (service/MATH.md, §3.8 and §3.9).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

from factorbus.proto.factor_kind import FactorKind

_RANGES = ("range_se2", "range_se3", "range_between_se2", "range_between_se3")
_BETWEEN = ("between_se2", "between_se3")
_POSITIONS = ("position_se2", "position_se3")
_SENSORS = (
    *("landmark_se2", "landmark_se3", "bearing_range_se2", "bearing_se2", "bearing_se3", "range_se2", "range_se3"),
    "point_seen",
)
# What of a lens is a variable, by modifier: its numbers, which stand in place of those that the measurement has.
LENSES = {
    "focal": ("f",),
    "bundler": ("f", "k1", "k2"),
    "intrinsics": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
}
# Those that are of the radial-tangential model alone.
RADTAN_LENSES = ("bundler", "intrinsics")
# Modifiers, and the base kinds that are there with them, in the order of their declaration.
DERIVED: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
    (("mount",), (*_BETWEEN, *_SENSORS)),
    (("bias",), _RANGES),
    (("scale",), _BETWEEN),
    (("arm",), _POSITIONS),
    (("frame",), _POSITIONS),
    (("frame", "arm"), _POSITIONS),
    (("offset",), (*_POSITIONS, *_SENSORS)),
    (("frame", "offset"), _POSITIONS),
    *((modifiers, ("point_seen",)) for lens in LENSES for modifiers in ((lens,), ("mount", lens))),
)
# The role of the variable that a modifier appends, where it is a pose: see `FactorKind.roles`.
_ROLES = {"mount": "mount", "frame": "frame"}
# Its letter in the table of the contract.
LETTERS = {
    "mount": "m",
    "bias": "β",
    "scale": "s",
    "frame": "f",
    "arm": "λ",
    "offset": "δ",
    **dict.fromkeys(LENSES, "c"),
}


def derived_kinds(kinds: Mapping[str, FactorKind]) -> Iterator[FactorKind]:
    """All kinds of `DERIVED`, made of those of `kinds`."""
    for modifiers, bases in DERIVED:
        for base in bases:
            made = kinds[base]
            roles = (*made.roles, *[""] * (len(made.connects) - len(made.roles)))
            for modifier in modifiers:
                made = _MODIFIERS[modifier](made)
            says = ", and ".join(_SAYS[modifier](kinds[base]) for modifier in modifiers)
            yield replace(
                made,
                name="_".join([base, *modifiers]),
                residual=f"that of {base} {says}",
                base=base,
                modifiers=modifiers,
                roles=(*roles, *(_ROLES.get(modifier, "") for modifier in modifiers)),
            )


def _with_end(kind: FactorKind, end: str) -> FactorKind:
    return replace(kind, connects=(*kind.connects, end))


def _dimension(kind: FactorKind) -> int:
    return 2 if kind.connects[0] == "se2" else 3


def _mount(kind: FactorKind) -> FactorKind:
    return _with_end(kind, kind.connects[0])


def _frame(kind: FactorKind) -> FactorKind:
    made = _with_end(kind, kind.connects[0])
    return replace(made, measured=kind.measured.replace(" in the map", " in the frame f"))


def _arm(kind: FactorKind) -> FactorKind:
    """The antenna's place on the robot, which is last in the measurement, is a variable."""
    n = _dimension(kind)
    made = _with_end(kind, f"vector{n}")
    measured = kind.measured.split(",")[0] + " (metres)"
    return replace(made, size=kind.size - n, example=kind.example[:-n], measured=measured)


def _number(kind: FactorKind) -> FactorKind:
    return _with_end(kind, "vector1")


def _lens(modifier: str) -> Callable[[FactorKind], FactorKind]:
    return lambda kind: _with_end(kind, f"vector{len(LENSES[modifier])}")


def _offset(kind: FactorKind) -> FactorKind:
    """Behind the measurement how the robot moves: its velocity and angular velocity, in its own frame."""
    twist = (1.0, 0.25, -0.5) if _dimension(kind) == 2 else (1.0, 0.25, -0.125, 0.0, -0.25, 0.5)
    moves = "vx vy (m/s), ω (rad/s)" if len(twist) == 3 else "vx vy vz (m/s), ωx ωy ωz (rad/s)"
    made = _with_end(kind, "vector1")
    return replace(
        made,
        size=kind.size + len(twist),
        example=(*kind.example, *twist),
        measured=f"{kind.measured}; ξ: {moves} of the robot, in its frame",
    )


def _lens_says(modifier: str) -> Callable[[FactorKind], str]:
    names = " ".join(LENSES[modifier])
    return lambda _: f"with {names} of the lens from c (pixels, and the model's own)"


def _instead(kind: FactorKind, pose: str) -> str:
    """With another pose in place of that of the robot."""
    if len(kind.connects) == 2 and kind.connects[0] == kind.connects[1]:
        return f"with {pose.format('a')} and {pose.format('b')} for a and b"
    letter = "x" if len(kind.connects) == 1 else "a"
    return f"with {pose.format(letter)} for {letter}"


_MODIFIERS: Mapping[str, Callable[[FactorKind], FactorKind]] = {
    "mount": _mount,
    "bias": _number,
    "scale": _number,
    "frame": _frame,
    "arm": _arm,
    "offset": _offset,
    **{lens: _lens(lens) for lens in LENSES},
}
_SAYS: Mapping[str, Callable[[FactorKind], str]] = {
    "mount": lambda kind: _instead(kind, "{} ∘ m"),
    "bias": lambda _: "plus β (metres)",
    "scale": lambda _: "with s t_z for t_z",
    "frame": lambda kind: _instead(kind, "f ∘ {}"),
    "arm": lambda _: "with λ a variable (metres)",
    "offset": lambda kind: _instead(kind, "{} ∘ Exp(ξ δ)") + ", δ in seconds",
    **{lens: _lens_says(lens) for lens in LENSES},
}
