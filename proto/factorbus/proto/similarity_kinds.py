"""The kinds of factors of rotations (so3), and of poses with a scale of their own (sim3): part of `kinds`."""

from factorbus.proto.factor_kind import FactorKind
from factorbus.proto.variable_kinds import ROTATION, SIMILARITY

_TURNED = (0.0, 0.0, 0.6, 0.8)
SIMILARITY_KINDS = (
    FactorKind(
        "prior_so3",
        ("so3",),
        4,
        3,
        ROTATION + ", in the map",
        "z⁻¹ ∘ x as (qx, qy, qz), sign with qw ≥ 0",
        _TURNED,
        half_angles=True,
    ),
    FactorKind(
        "between_so3",
        ("so3", "so3"),
        4,
        3,
        ROTATION + ": the second rotation in the first one's frame",
        "z⁻¹ ∘ (a⁻¹ ∘ b) as (qx, qy, qz), qw ≥ 0",
        _TURNED,
        half_angles=True,
    ),
    FactorKind(
        "attitude_so3",
        ("so3",),
        6,
        3,
        "a direction as the robot sees it, the same in the map (any length)",
        "Rᵀ g/‖g‖ − b/‖b‖, b as the robot sees it, g in the map",
        (0.0, 0.1, -1.0, 0.0, 0.0, -9.81),
    ),
    FactorKind(
        "prior_sim3",
        ("sim3",),
        8,
        7,
        SIMILARITY + ", in the map",
        "z⁻¹ ∘ x as (x, y, z, qx, qy, qz, ln s), sign with qw ≥ 0",
        (1.0, 2.0, 3.0, *_TURNED, 1.5),
        half_angles=True,
    ),
    FactorKind(
        "between_sim3",
        ("sim3", "sim3"),
        8,
        7,
        SIMILARITY + ": the second pose in the first one's frame and unit",
        "z⁻¹ ∘ (a⁻¹ ∘ b) as (x, y, z, qx, qy, qz, ln s), qw ≥ 0",
        (1.0, 0.0, 0.5, *_TURNED, 1.25),
        half_angles=True,
    ),
    FactorKind(
        "landmark_sim3",
        ("sim3", "point3"),
        3,
        3,
        "x y z of the point in the pose's frame, in its unit",
        "Rₐᵀ (l − tₐ) / sₐ − z",
        (2.0, 1.0, 0.5),
    ),
    FactorKind("position_sim3", ("sim3",), 3, 3, "x y z in the map (metres)", "t − z", (4.0, 5.0, 6.0)),
)
