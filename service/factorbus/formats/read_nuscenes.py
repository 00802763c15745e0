"""Read the poses of the vehicle in a nuScenes data set: its ego_pose.json.

    [{"token": "…", "timestamp": 1532402927647951, "rotation": [w, x, y, z], "translation": [x, y, z]}, …]

The time is in microseconds, in no order, and each camera, radar and lidar has an entry of its own: entries of one time
are one pose.  The scenes of the data set follow each other, each in the frame of its city.
"""

import math

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.graph import GraphFile
from factorbus.formats.json_parts import Part, parsed_json
from factorbus.formats.rotations import normalized_poses
from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.symbols import symbol
from factorbus.wording import counted

NUSCENES = "nuscenes"
_MICROSECOND = 1_000
_LATEST = (2**63 - 1) // _MICROSECOND
_MEMBERS = b'"timestamp"', b'"rotation"', b'"translation"'
_BEGIN = 4096  # bytes that the first entry is within
# Entries of a scene are some milliseconds apart: what is later by this is another scene.
_GAP_NS = 2 * 10**9
_NORM_TOLERANCE = 0.02  # as of the quaternions of other files


def is_nuscenes(content: bytes) -> bool:
    """Whether a file is a JSON array whose first entry is a pose with its time."""
    begin = content[:_BEGIN]
    return begin.lstrip()[:1] == b"[" and all(name in begin for name in _MEMBERS)


def read_nuscenes(file: str, content: bytes) -> GraphFile:
    """The poses as x0, x1, ... in the order of time; there are no factors.  Raises FormatError."""
    entries = parsed_json(file, content).items()
    if not entries:
        raise FormatError(file, None, "no pose", "an array of objects with timestamp, rotation and translation")
    rows = [_entry(each) for each in entries]
    times = np.array([time for time, _ in rows], np.int64)
    stamps, first = np.unique(times, return_index=True)  # of equal ones the first
    values = np.array([rows[k][1] for k in first])
    poses = np.ascontiguousarray(normalized_poses(file, "ego pose", first, values))
    stamps *= _MICROSECOND
    group = Variables("se3", symbol("x", 0) + np.arange(len(stamps)), poses, False, stamps)
    return GraphFile(file, NUSCENES, Batch((group,)), (), _notes(times, stamps, poses, rows))


def _entry(each: Part) -> tuple[int, list[float]]:
    """(microseconds, x y z qx qy qz qw)."""
    rotation = each.member("rotation")
    w, *vector = rotation.numbers(4)
    if abs(math.hypot(w, *vector) - 1) > _NORM_TOLERANCE:
        raise rotation.refused("a unit quaternion w x y z", f"a quaternion of norm {math.hypot(w, *vector):.6g}")
    time = each.member("timestamp").whole(0, _LATEST)
    return time, [*each.member("translation").numbers(3), *vector, w]


def _notes(times: I64, stamps: I64, poses: F64, rows: list[tuple[int, list[float]]]) -> tuple[str, ...]:
    notes, twice = [], len(times) - len(stamps)
    if twice:
        notes.append(f"{counted(twice, 'entry', 'entries')} of the time of another left out: they are one pose")
    where = poses[np.searchsorted(stamps, times * _MICROSECOND), :3]
    apart = float(np.abs(np.array([row[:3] for _, row in rows]) - where).max())
    if apart > 0.01:
        notes.append(f"entries of one time are up to {apart:.3g} m apart; the first of them counts")
    if parts := int((np.diff(stamps) > _GAP_NS).sum()):
        notes.append(
            f"{parts + 1} drives, more than {_GAP_NS // 10**9} s apart in time, as one trajectory: nuScenes's scenes, "
            "which may be of several cities"
        )
    return tuple(notes)
