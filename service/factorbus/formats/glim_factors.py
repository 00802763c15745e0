"""The factors of a map of GLIM's that are read, and what becomes of them."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from factorbus.formats.assemble import EdgeColumns
from factorbus.formats.gtsam_archive import archived_graph
from factorbus.formats.gtsam_forms import BETWEEN, DAMPING, POSITION, PRIOR, ArchivedFactor
from factorbus.formats.jrl import GTSAM_ORDER
from factorbus.formats.left_out import LeftOut
from factorbus.formats.lines import read_content
from factorbus.formats.rotations import quats_of_matrices
from factorbus.formats.weights import doubled_rotations, packed_upper, positive_definite
from factorbus.proto.arrays import F64
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.wording import counted

_KINDS = {BETWEEN: "between_se3", PRIOR: "prior_se3", POSITION: "position_se3"}
# GTSAM's m-estimators that are losses here; the scale of one is its parameter to that power.
_LOSSES = {
    "Huber": ("huber", 1.0),
    "Cauchy": ("cauchy", 1.0),
    "GemanMcClure": ("geman-mcclure", 1.0),
    "Tukey": ("tukey", 1.0),
    "DCS": ("dcs", 0.5),
}
_HOLDS = 1e6  # a damping of this and more fixes a pose: GLIM's first one has 1e10, and one that it mends 1e4
_LEAST, _MOST = 1e-12, 1e12  # scales of a loss
_SKEW = 1e-3


def archived_factors(path: Path, poses: set[int], left: LeftOut) -> list[ArchivedFactor]:
    """The factors of graph.bin that are of `poses` alone and are read.  Raises FormatError, also when strict."""
    if not path.is_file():
        left.drop(path.name, 1, "there is no such file beside graph.txt")
        return []
    graph = archived_graph(read_content(path))
    if graph.missing:
        why = f"what comes after {counted(len(graph.factors), 'factor')} cannot be read: {graph.why}"
        left.drop(f"of the factors in {path.name}", graph.missing, why)
    elif graph.why:
        left.drop(path.name, 1, f"it cannot be read: {graph.why}")
    kept, foreign = [], Counter[str]()
    odd: Counter[tuple[str, str]] = Counter()
    for factor in graph.factors:
        if not poses.issuperset(factor.keys):
            foreign[factor.name] += 1
        elif why := _unread(factor):
            odd[factor.name, why] += 1
        else:
            kept.append(factor)
    for name, count in foreign.items():
        left.drop(name, count, "on velocities, biases or ends of submaps, which this map does not have")
    for (name, why), count in odd.items():
        left.drop(name, count, why)
    return kept


def factor_edges(factors: Sequence[ArchivedFactor]) -> list[EdgeColumns]:
    """What they measure, in our terms; each factor's turn is its place among them."""
    groups: dict[tuple[str, str], list[tuple[int, ArchivedFactor]]] = {}
    for turn, factor in enumerate(factors):
        if factor.name in _KINDS:
            groups.setdefault((factor.name, factor.noise.loss), []).append((turn, factor))
    return [_columns(name, loss, rows) for (name, loss), rows in groups.items()]


def _columns(name: str, loss: str, rows: list[tuple[int, ArchivedFactor]]) -> EdgeColumns:
    kind = FACTOR_KINDS[_KINDS[name]]
    measured = np.array([factor.measured for _, factor in rows])
    if kind.size == 7:
        measured = np.concatenate([measured[:, 9:], quats_of_matrices(measured[:, :9].reshape(-1, 3, 3))], axis=1)
    else:
        measured = np.concatenate([measured, np.zeros((len(rows), kind.size - 3))], axis=1)  # it is at the sensor
    information = np.array([_information(factor) for _, factor in rows])
    if kind.half_angles:
        information = information[:, GTSAM_ORDER][:, :, GTSAM_ORDER]
    packed = packed_upper(information)
    name, power = _LOSSES.get(loss, ("", 0.0))
    return EdgeColumns(
        kind.name,
        np.array([turn for turn, _ in rows], np.int64),
        np.array([factor.keys for _, factor in rows], np.int64),
        measured,
        doubled_rotations(packed) if kind.half_angles else packed,
        name,
        np.array([factor.noise.parameter**power for _, factor in rows]) if name else None,
    )


def _information(factor: ArchivedFactor) -> F64:
    """In the order of GTSAM's tangent space."""
    return factor.noise.root.T @ factor.noise.root


def _unread(factor: ArchivedFactor) -> str:
    """Why a factor of poses is left out; empty: it is read."""
    if factor.name == DAMPING:
        return "" if factor.strength >= _HOLDS else "too weak to hold a pose"
    if factor.name not in _KINDS:
        return "no factor of poses that is read"
    if len(set(factor.keys)) < len(factor.keys):
        return "of a pose and itself"
    noise, dim = factor.noise, FACTOR_KINDS[_KINDS[factor.name]].dim
    if not noise.root.size:
        return "without a covariance"
    if noise.loss and not _is_scale(noise.loss, noise.parameter):
        return f"with the loss {noise.loss} of {noise.parameter:g}"
    if noise.root.shape != (dim, dim) or not positive_definite(packed_upper(_information(factor)[None]), dim)[0]:
        return "with an information that is not positive definite"
    return "" if _is_rigid(factor.measured) else "with numbers that are no position or rigid transform"


def _is_scale(loss: str, parameter: float) -> bool:
    """Whether a loss here has such a scale; below 0 the root of one is no number."""
    return loss in _LOSSES and parameter > 0.0 and _LEAST <= parameter ** _LOSSES[loss][1] <= _MOST


def _is_rigid(measured: F64) -> bool:
    if not np.isfinite(measured).all():
        return False
    R = measured[:9].reshape(3, 3) if measured.size == 12 else np.eye(3)
    return bool(np.abs(R @ R.T - np.eye(3)).max() < _SKEW and np.linalg.det(R) > 0)
