"""Linear factors of a map that goes into another frame: what they say of where it is, and how they move with it."""

import numpy as np

from factorbus.client.frames import inverse, rotation_of
from factorbus.client.roles import Roles
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import VARIABLE_KINDS
from factorbus.proto.linear import parts_of
from factorbus.proto.messages import Factors
from factorbus.proto.roles import AXES, FRAME, MOUNT

# Of numbers that cancel: what a factor of a solver's own making differs from zero by.
_ROUNDING = 1e-6


def are_relative(group: Factors, roles: Roles) -> np.ndarray:
    """Of each of the linear factors of a kind, whether it says nothing of where its variables are together.

    With x_n ⊟ y_n after a small motion ξ of the whole frame being G_n ξ, it says nothing if Σ H_n G_n = 0, nor if it is
    on velocities alone, which are as certain in any frame.
    roles: of variables that do not move with the frame as places do.
    """
    kinds, y, H, _ = parts_of(group.kind, group.measured)
    role = [_roles_of(keys, roles) for keys in group.keys.T]
    said = np.zeros(len(group.keys), bool)
    for n in range(len(group.keys)):
        ends = zip(kinds, role, y, H, strict=True)
        parts = [J[n] @ _carried(kind, at[n], of[n]) for kind, of, at, J in ends if _moves(kind, of[n])]
        of_no_place = all(of[n] == AXES or not _moves(kind, of[n]) for kind, of in zip(kinds, role, strict=True))
        said[n] = of_no_place or np.abs(sum(parts)).max() <= _ROUNDING * max(np.abs(parts).max(), 1e-300)
    return said


def _roles_of(keys: I64, roles: Roles) -> list[str]:
    """The role of each variable (n,)."""
    found = np.full(len(keys), "", dtype="U8")
    for role, chosen in roles.rows(keys):
        found[chosen] = role
    return found.tolist()


def _moves(kind: str, role: str) -> bool:
    """Whether a variable changes as the frame moves."""
    return role == AXES or not (role == MOUNT or VARIABLE_KINDS[kind].is_vector)


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
    if not _moves(kind, role) or kind in ("se2", "se3", "so3", "sim3"):
        return H
    if kind != "idp":
        return H @ R.T
    turned = H.copy()
    turned[:, :, :3] = H[:, :, :3] @ R.T
    for n, (y, there) in enumerate(zip(before, after, strict=True)):
        turned[n, :, 3:5] = H[n, :, 3:5] @ np.linalg.inv(_angles(there) @ R @ _ray(y)[1])
    return turned


def _adjoint(T: F64) -> F64:
    """Ad(T): Exp(Ad(T) ξ) = T Exp(ξ) T⁻¹, ξ = (translation, rotation)."""
    R = rotation_of(T)
    if T.size == 3:
        return np.block([[R, np.array([[T[1]], [-T[0]]])], [np.zeros((1, 2)), np.ones((1, 1))]])
    return np.block([[R, _cross(T[:3]) @ R], [np.zeros((3, 3)), R]])


def _carried(kind: str, y: F64, role: str) -> F64:
    """G: the increment of a value when the frame that it is in moves by ξ = (translation, rotation)."""
    if role == FRAME:
        return -np.eye(VARIABLE_KINDS[kind].dim)
    if role == AXES:
        turn = np.array([[-y[1]], [y[0]]]) if y.size == 2 else -_cross(y)
        return np.column_stack([np.zeros((y.size, y.size)), turn])
    if kind == "point2":
        return np.array([[1.0, 0.0, -y[1]], [0.0, 1.0, y[0]]])
    if kind == "se2":
        R = rotation_of(y)
        return np.block([[R.T, (R.T @ [-y[1], y[0]])[:, None]], [np.zeros((1, 2)), np.ones((1, 1))]])
    if kind == "so3":
        return np.column_stack([np.zeros((3, 3)), rotation_of(np.concatenate([np.zeros(3), y])).T])
    if kind == "sim3":
        R, moved = rotation_of(y[:7]), np.column_stack([np.eye(3), -_cross(y[:3])])
        return np.concatenate([R.T @ moved / y[7], np.column_stack([np.zeros((3, 3)), R.T]), np.zeros((1, 6))])
    moved = np.column_stack([np.eye(3), -_cross(y)])
    if kind == "point3":
        return moved
    if kind == "idp":
        turn = np.column_stack([np.zeros((2, 3)), -_angles(y) @ _cross(_ray(y)[0])])
        return np.concatenate([moved, turn, np.zeros((1, 6))])
    R = rotation_of(y)
    return np.concatenate([R.T @ moved, np.column_stack([np.zeros((3, 3)), R.T])])


def _cross(v: F64) -> F64:
    """⌊v⌋"""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _ray(y: F64) -> tuple[F64, F64]:
    """(the direction m of a feature, its Jacobian (3, 2) by θ and φ)."""
    (s, t), (c, d) = np.sin(y[3:5]), np.cos(y[3:5])
    return np.array([d * s, -t, d * c]), np.array([[d * c, -t * s], [0.0, -d], [-d * s, -t * c]])


def _angles(y: F64) -> F64:
    """The Jacobian (2, 3) of θ and φ by the direction."""
    x, _, z = _ray(y)[0]
    flat = x * x + z * z
    return np.array([[z / flat, 0.0, -x / flat], [0.0, -1.0 / np.sqrt(flat), 0.0]])
