"""A trajectory and a list of loop closures, put together as a graph: what a front end without a graph leaves behind.

    first second tx ty tz qx qy qz qw [sigma_m sigma_rad]

is the pose of the second as seen from the first.  Poses are named by their place in the trajectory, 0 1 2 ..., or all
by their times.  Between one pose and the next is odometry, as the trajectory has it.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from factorbus.formats.errors import FormatError, refuse_first
from factorbus.formats.graph import GraphFile
from factorbus.formats.lines import read_content
from factorbus.formats.rotations import compose_poses, inverse_poses, normalized_poses
from factorbus.formats.seconds import is_time, nanoseconds
from factorbus.formats.weights import doubled_rotations, packed_upper
from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Batch, Factors
from factorbus.proto.stamps import NO_STAMP
from factorbus.wording import counted

# Of odometry, per metre and per radian, and at least; of a closure that does not say.  As the bridge from ROS has them.
DRIFT_M, DRIFT_RAD, TURN_RAD, LEAST = 0.02, 0.01, 0.02, 0.001
CLOSURE_M, CLOSURE_RAD = 0.05, 0.02
_NEAR_NS = 1_000_000
_FIELDS = "first second tx ty tz qx qy qz qw, and sigma_m sigma_rad if known"


def with_loops(graph: GraphFile, path: Path) -> GraphFile:
    """`graph`, a trajectory, with odometry between its poses and the closures in `path`.  Raises FormatError."""
    group = graph.batch.variables[0] if len(graph.batch.variables) == 1 else None
    poses = None if group is None else group.values
    if graph.batch.factors or group is None or poses is None:
        raise FormatError(
            graph.path, None, "a graph", "a trajectory (TUM, COLMAP, nuScenes), to which a list of loops is added"
        )
    stamps = group.stamps
    if stamps is not None and (stamps != NO_STAMP).all():
        order = np.argsort(stamps, kind="stable")
        poses, stamps = poses[order], stamps[order]
        group = group._replace(keys=group.keys[order], values=poses, stamps=stamps)
    lines, ends, measured, sigmas = _closures(str(path), read_content(path, f"lines of {_FIELDS}"), stamps, len(poses))
    steps = np.arange(len(poses) - 1)
    odometry = compose_poses(inverse_poses(poses[:-1]), poses[1:])
    keys = np.concatenate([np.stack([steps, steps + 1], axis=1), ends])
    both = np.concatenate([_odometry_sigmas(odometry), sigmas])
    factors = Factors(
        "between_se3", group.keys[keys], np.concatenate([odometry, measured]),
        doubled_rotations(packed_upper(np.stack([np.diag(each) for each in both**-2.0]))),
    )  # fmt: skip
    turns = np.concatenate([np.zeros(len(steps), np.int64), lines])
    note = (
        f"{counted(len(lines), 'loop closure')} of {path}, and {counted(len(steps), 'step')} of odometry between the "
        f"poses, with {DRIFT_M:.0%} of the way as its sigma; closures that have none get {CLOSURE_M} m and "
        f"{CLOSURE_RAD} rad"
    )
    return replace(graph, batch=Batch((group,), (factors,)), factor_lines=(turns,), notes=(*graph.notes, note))


def _odometry_sigmas(steps: F64) -> F64:
    """(n, 6)"""
    way = np.linalg.norm(steps[:, :3], axis=1)
    turned = 2 * np.arctan2(np.linalg.norm(steps[:, 3:6], axis=1), np.abs(steps[:, 6]))
    metres = np.maximum(LEAST, DRIFT_M * way)
    radians = np.maximum(LEAST, DRIFT_RAD * way + TURN_RAD * turned)
    return np.repeat(np.stack([metres, radians], axis=1), 3, axis=1)


def _closures(file: str, content: bytes, stamps: I64 | None, count: int) -> tuple[I64, I64, F64, F64]:
    """Lines (n,), the places of both ends (n, 2), measured (n, 7), sigmas (n, 6).  Raises FormatError."""
    rows = [
        (line, words)
        for line, text in enumerate(content.decode("utf-8", "backslashreplace").split("\n"), 1)
        if (words := text.partition("#")[0].split())
    ]
    if not rows:
        raise FormatError(file, None, "no loop closure", f"lines of {_FIELDS}")
    for line, words in rows:
        if len(words) not in (9, 11) or not all(map(is_time, words)):
            raise FormatError(file, line, f"{' '.join(words)[:60]!r}", _FIELDS)
    lines = np.array([line for line, _ in rows], np.int64)
    ends = np.array(_ends(file, rows, stamps, count))
    refuse_first(file, lines, ends[:, 0] == ends[:, 1], lambda row: "a pose and itself", "two poses")
    numbers = np.array([[float(each) for each in words[2:9]] for _, words in rows])
    given = np.array([[float(each) for each in words[9:]] or [CLOSURE_M, CLOSURE_RAD] for _, words in rows])
    refuse_first(file, lines, ~(given > 0).all(axis=1), lambda row: f"sigmas {given[row].tolist()}", "more than 0")
    whole = np.concatenate([numbers, given], axis=1)
    refuse_first(file, lines, ~np.isfinite(whole).all(axis=1), lambda row: "a number that is not finite", "numbers")
    return lines, ends, normalized_poses(file, "a loop closure", lines, numbers), np.repeat(given, 3, axis=1)


def _ends(file: str, rows: list[tuple[int, list[str]]], stamps: I64 | None, count: int) -> list[list[int]]:
    """The places of both ends, which all lines have, or times.  Raises FormatError, with the pose that is neither."""
    named = [(line, name) for line, words in rows for name in words[:2]]
    others = [(line, name) for line, name in named if not _is_place(name, count)]
    if not others:
        return [[int(name) for name in words[:2]] for _, words in rows]
    try:
        return [[_at_time(file, line, name, stamps, count) for name in words[:2]] for line, words in rows]
    except FormatError:
        # All are whole numbers: places are meant, and the first that is none is wrong, not the first that is no time.
        if all(name.isdigit() for _, name in named):
            _at_time(file, *others[0], stamps, count)
        raise


def _is_place(name: str, count: int) -> bool:
    return name.isdigit() and int(name) < count


def _at_time(file: str, line: int, name: str, stamps: I64 | None, count: int) -> int:
    if stamps is None or (stamps == NO_STAMP).any():
        raise FormatError(file, line, f"pose {name}", f"a place from 0 to {count - 1}: the trajectory has no times")
    time = nanoseconds(file, line, name)
    place = int(np.abs(stamps - time).argmin())
    if abs(int(stamps[place]) - time) > _NEAR_NS:
        wanted = f"a place from 0 to {count - 1}, or within a millisecond the time of a pose"
        raise FormatError(file, line, f"pose {name}", wanted)
    return place
