"""Factors of a map that goes into another frame: most relative ones are the same in every frame."""

import numpy as np

from factorbus.client.roles import Roles
from factorbus.client.transform_linear import transform_linear
from factorbus.proto.arrays import F64
from factorbus.proto.inertial import GRAVITY
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.linear_in_frame import rotation_of
from factorbus.proto.messages import Factors


def transform_factors(group: Factors, T_a_b: F64, roles: Roles) -> Factors:
    """Relative factors given in b, as they are in a.  roles: of variables that are no places in the map."""
    kind = FACTOR_KINDS[group.kind]
    if kind.is_linear:
        return transform_linear(group, T_a_b, roles)
    if kind.imu:
        return group if kind.imu.gravity else _transform_inertial(group, T_a_b, kind.imu.gravity_at)
    return _transform_first(group, T_a_b) if group.kind == "idp_first" else group


def _transform_inertial(group: Factors, T_a_b: F64, at: int) -> Factors:
    """Gravity, measured from `at` on, turns with the map; what an IMU measures is in its own frame."""
    measured = group.measured.copy()
    measured[:, at : at + GRAVITY] = measured[:, at : at + GRAVITY] @ rotation_of(T_a_b).T
    return group._replace(measured=measured)


def _transform_first(group: Factors, T_a_b: F64) -> Factors:
    """`idp_first`: the first three rows of the residual are along the map's axes: Ω turns with them."""
    rows, columns = np.triu_indices(6)
    turn = np.eye(6)
    turn[:3, :3] = rotation_of(T_a_b)
    full = np.zeros((len(group.keys), 6, 6))
    full[:, rows, columns] = full[:, columns, rows] = group.information
    return group._replace(information=np.ascontiguousarray((turn @ full @ turn.T)[:, rows, columns]))
