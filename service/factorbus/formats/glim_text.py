"""The text files of a map that GLIM has saved: graph.txt, and data.txt of every submap.

    graph.txt    num_submaps: N                  000000/data.txt    id: 0
                 num_all_frames: M                                  T_world_origin:
                 num_matching_cost_factors: K                       four lines of four numbers
                 matching_cost vgicp 0 1                            T_origin_endpoint_L:   T_origin_endpoint_R:
                 ...                                                T_lidar_imu:   imu_bias: six numbers
                 pruned_range 3 4                                   frame_id: 2
                                                                    num_frames: 15
                                                                    frame_0
                                                                    id: 0
                                                                    stamp: 1700000000.123456789
                                                                    T_odom_lidar:   T_world_lidar:   v_world_imu: ...

T_a_b takes coordinates in b to coordinates in a.  Numbers have six digits.  What else stands there is not looked at.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.lines import Bucket, read_content
from factorbus.formats.numbers import read_numbers
from factorbus.formats.rotations import compose_poses, quats_of_matrices
from factorbus.formats.seconds import nanoseconds
from factorbus.proto.arrays import F64
from factorbus.wording import counted

GRAPH_TEXT = "graph.txt"
_FRAME = re.compile(r"frame_\d+")
_METHOD = re.compile(r"[\w.+-]{1,40}", re.ASCII)  # it is shown
_COUNT = re.compile(r"\d{1,18}")
_MOST_SUBMAPS = 1_000_000  # their folders have six digits
_SKEW = 0.01  # how far the six digits of a rotation matrix may be from one
_IMU_FRAME = 2  # of GLIM's FrameID
_IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])
_Section = dict[str, tuple[int, list[str]]]  # what follows a name, and its line


@dataclass(frozen=True, slots=True)
class MatchingCost:
    """Two submaps whose point clouds GLIM holds against each other, and by which method; line: in graph.txt."""

    line: int
    method: str
    first: int
    second: int


@dataclass(frozen=True, slots=True)
class GlimIndex:
    """What graph.txt says.  submaps: numbers of those that are in the map."""

    submaps: tuple[int, ...]
    costs: tuple[MatchingCost, ...]


@dataclass(frozen=True, slots=True)
class Submap:
    """A submap: poses (7,) x y z qx qy qz qw, of its sensor.

    T_origin_left, T_origin_right: of its first and its last frame.  T_odom_left, T_odom_right: the same two in the
    frame of odometry.  left_id, right_id: their numbers.  Without frames stamp is None, and those are of no meaning.
    is_imu: whether the sensor is the IMU, and not the lidar.
    """

    number: int
    T_world_origin: F64
    T_origin_left: F64
    T_origin_right: F64
    frames: int
    stamp: int | None = None
    T_odom_left: F64 = field(default_factory=lambda: _IDENTITY)
    T_odom_right: F64 = field(default_factory=lambda: _IDENTITY)
    left_id: int = 0
    right_id: int = 0
    is_imu: bool = False


def is_glim_text(content: bytes) -> bool:
    """Whether it is a graph.txt."""
    return content.lstrip()[:12] == b"num_submaps:"


def read_index(path: Path) -> GlimIndex:
    """graph.txt.  Raises FormatError."""
    file, count, ranges, costs = str(path), None, [], []
    for line, words in _lines(path):
        if words[0] == "num_submaps:":
            count = _whole(file, line, words, 1)
        elif words[0] == "pruned_range":
            ranges.append((_whole(file, line, words, 1), _whole(file, line, words, 2)))
        elif words[0] == "matching_cost":
            method = words[1] if len(words) > 3 else ""  # GLIM writes none for a method that it does not know
            ends = [_whole(file, line, words, place) for place in (len(words) - 2, len(words) - 1)]
            costs.append(MatchingCost(line, method if _METHOD.fullmatch(method) else "", *ends))
    if not count or count > _MOST_SUBMAPS:
        seen = f"{count:,} submaps" if count else "no submap"
        raise FormatError(file, None, seen, f'a line "num_submaps: N" with 1 to {_MOST_SUBMAPS:,}')
    is_there = np.ones(count, bool)
    for first, last in ranges:
        is_there[first : last + 1] = False
    there = tuple(np.flatnonzero(is_there).tolist())
    if not there:
        raise FormatError(file, None, f"every one of {counted(count, 'submap')} pruned", "one or more that is not")
    for cost in costs:
        for end in (cost.first, cost.second):
            if end >= count or not is_there[end]:
                raise FormatError(
                    file, cost.line, f"matching_cost of submap {end}", f"one of the {len(there)} there are"
                )
        if cost.first == cost.second:
            raise FormatError(file, cost.line, f"matching_cost of submap {cost.first} with itself", "two submaps")
    return GlimIndex(there, tuple(costs))


def read_submap(folder: Path, number: int) -> Submap:
    """Submap `number` of the map in `folder`.  Raises FormatError."""
    path = folder / f"{number:06d}" / "data.txt"
    head, *frames = _sections(path)
    places = [_pose(path, head, name) for name in ("T_world_origin", "T_origin_endpoint_L", "T_origin_endpoint_R")]
    if not frames:
        return Submap(number, *places, frames=0)
    is_imu = int(_words(path, head, "frame_id", 1)[1][0] == str(_IMU_FRAME))
    T_lidar_sensor = _pose(path, head, "T_lidar_imu") if is_imu else _IDENTITY
    left, right = (
        compose_poses(_pose(path, frame, "T_odom_lidar")[None], T_lidar_sensor[None])[0]
        for frame in (frames[0], frames[-1])
    )
    line, time = _words(path, frames[len(frames) // 2], "stamp", 1)  # the frame at which the origin is
    return Submap(
        number,
        *places,
        frames=len(frames),
        stamp=nanoseconds(str(path), line, time[0]),
        T_odom_left=left,
        T_odom_right=right,
        left_id=_frame_id(path, frames[0]),
        right_id=_frame_id(path, frames[-1]),
        is_imu=bool(is_imu),
    )


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """(number, words) of lines that have any.  Raises FormatError."""
    lines = read_content(path).decode("utf-8", "backslashreplace").split("\n")
    return [(number, words) for number, line in enumerate(lines, 1) if (words := line.split())]


def _sections(path: Path) -> list[_Section]:
    """What precedes the frames, and each frame: by name what follows it.  Raises FormatError."""
    sections: list[_Section] = [{}]
    name = ""
    for line, words in _lines(path):
        if _FRAME.fullmatch(words[0]):
            sections.append({})
            name = ""
        elif words[0].endswith(":"):
            name = words[0][:-1]
            sections[-1][name] = (line, words[1:])
        elif name:
            sections[-1][name][1].extend(words)
    return sections


def _words(path: Path, section: Mapping[str, tuple[int, list[str]]], name: str, count: int) -> tuple[int, list[str]]:
    """(line, the words that follow a name).  Raises FormatError unless there are `count`."""
    if name not in section:
        raise FormatError(str(path), None, f"no {name}", f'a line "{name}:" and what it is, as GLIM writes it')
    line, words = section[name]
    if len(words) != count:
        raise FormatError(str(path), line, f"{name} with {counted(len(words), 'number')}", f"{count}")
    return line, words


def _pose(path: Path, section: _Section, name: str) -> F64:
    """A matrix of four rows as a pose.  Raises FormatError."""
    line, words = _words(path, section, name, 16)
    bucket = Bucket([" ".join(words).encode()], [line])
    T = read_numbers(str(path), name, bucket, 0, 16, "four rows of four")[1].reshape(4, 4)
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _SKEW or np.linalg.det(R) < 0 or T[3].tolist() != [0, 0, 0, 1]:
        raise FormatError(str(path), line, f"{name} that is no rotation and translation", "a rigid transform")
    return np.concatenate([T[:3, 3], quats_of_matrices(R[None])[0]])


def _frame_id(path: Path, frame: _Section) -> int:
    line, words = _words(path, frame, "id", 1)
    return _whole(str(path), line, words, 0)


def _whole(file: str, line: int, words: list[str], place: int) -> int:
    """The whole number at that place of a line.  Raises FormatError."""
    if not 0 <= place < len(words) or not _COUNT.fullmatch(words[place]):
        seen = words[place][:40] if 0 <= place < len(words) else "nothing"
        raise FormatError(file, line, f"{words[0][:40]} with {seen}", "a whole number")
    return int(words[place])
