"""Linear factors of a map that goes into another frame: what they say of where it is, and how they move with it."""

import numpy as np

from factorbus.client.frames import inverse
from factorbus.client.roles import Roles
from factorbus.proto.arrays import F64, I64
from factorbus.proto.linear import parts_of
from factorbus.proto.linear_in_frame import angles_by_ray, moves_with_frame, ray_of, rotation_of, said_of_frame
from factorbus.proto.messages import Factors
from factorbus.proto.roles import AXES, FRAME


def are_relative(group: Factors, roles: Roles) -> np.ndarray:
    """Of each of the linear factors of a kind, whether it says nothing of where its variables are together.

    roles: of variables that do not move with the frame as places do.
    """
    return ~said_of_frame(group, [_roles_of(keys, roles) for keys in group.keys.T]).anything


def _roles_of(keys: I64, roles: Roles) -> list[str]:
    """The role of each variable (n,)."""
    found = np.full(len(keys), "", dtype="U8")
    for role, chosen in roles.rows(keys):
        found[chosen] = role
    return found.tolist()


def transform_linear(group: Factors, T_a_b: F64, roles: Roles) -> Factors:
    """y moves with x.  Of a pose x ⊟ y is local, and the same; of a point it turns with the frame, and H against it, as
    of a vector along the frame's axes.

    roles: of variables that do not move with the frame as places do.
    """
    parts, y, H = parts_of(group.kind, group.measured), [], []
    for kind, before, J, keys in zip(parts.kinds, parts.y, parts.H, group.keys.T, strict=True):
        after, turned = roles.moved(kind, keys, before, T_a_b), J.copy()
        for role, of in roles.rows(keys):
            turned[of] = _turned(kind, role, before[of], after[of], J[of], T_a_b)
        y.append(after)
        H.append(turned)
    return group._replace(measured=parts._replace(y=y, H=H).measured())


def _turned(kind: str, role: str, before: F64, after: F64, H: F64, T_a_b: F64) -> F64:
    """H of increments after the motion.  Of a feature's direction that is so to first order."""
    R = rotation_of(T_a_b)
    if role == FRAME:
        return H @ _adjoint(inverse(T_a_b))
    if role == AXES:
        return H @ R.T
    if not moves_with_frame(kind, role) or kind in ("se2", "se3", "so3", "sim3"):
        return H
    if kind != "idp":
        return H @ R.T
    turned = H.copy()
    turned[:, :, :3] = H[:, :, :3] @ R.T
    for n, (y, there) in enumerate(zip(before, after, strict=True)):
        turned[n, :, 3:5] = H[n, :, 3:5] @ np.linalg.inv(angles_by_ray(there) @ R @ ray_of(y)[1])
    return turned


def _adjoint(T: F64) -> F64:
    """Ad(T): Exp(Ad(T) ξ) = T Exp(ξ) T⁻¹, ξ = (translation, rotation)."""
    R = rotation_of(T)
    if T.size == 3:
        return np.block([[R, np.array([[T[1]], [-T[0]]])], [np.zeros((1, 2)), np.ones((1, 1))]])
    return np.block([[R, _cross(T[:3]) @ R], [np.zeros((3, 3)), R]])


def _cross(v: F64) -> F64:
    """⌊v⌋"""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
