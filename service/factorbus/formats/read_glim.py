"""Read a map that GLIM has saved: a folder with graph.txt, graph.bin and a folder for every submap.

A submap is a pose, x0, x1, ...: of the IMU or the lidar at its middle frame, with the time of that frame.  Factors are

    BetweenFactor<Pose3> of two submaps         between_se3, with the loss that it has
    PriorFactor<Pose3>                          prior_se3
    PoseTranslationPrior<Pose3>                 position_se3, as GLIM's extension for GNSS adds them
    LinearDampingFactor                         a fixed pose, where it holds a pose as GLIM holds the first

from graph.bin.  Two submaps whose point clouds GLIM matches (`matching_cost` in graph.txt) have a factor that only
those clouds give; it is read as the relative pose that GLIM has found, with the weight that GLIM gives to a relative
pose of which it knows no covariance.  Where nothing joins a submap to the one before it, their odometry does, with that
weight too, as GLIM itself recovers a graph.  Velocities, biases and endpoints of submaps, and the factors on them, are
left out.
"""

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np

from factorbus.formats.assemble import EdgeColumns, VertexColumns, assembled
from factorbus.formats.glim_factors import archived_factors, factor_edges
from factorbus.formats.glim_text import GRAPH_TEXT, GlimIndex, Submap, is_glim_text, read_index, read_submap
from factorbus.formats.gtsam_forms import DAMPING
from factorbus.formats.left_out import LeftOut
from factorbus.formats.rotations import compose_poses, inverse_poses
from factorbus.formats.weights import doubled_rotations, packed_upper
from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Batch
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import symbol
from factorbus.wording import counted

GLIM = "glim"
GRAPH_BINARY = "graph.bin"
_UNKNOWN_COVARIANCE = 1e6  # GLIM's precision of a relative pose of which it has no covariance, per m² and rad²


def is_glim(path: Path) -> bool:
    """Whether it is the folder of such a map, or the graph.txt in it; by their names alone, to say what it lacks."""
    if (path / GRAPH_TEXT).is_file() and (path / GRAPH_BINARY).is_file():
        return True
    index = path / GRAPH_TEXT if path.is_dir() else path
    if not index.is_file():  # what is read from a pipe is not there again
        return False
    try:
        with index.open("rb") as text:
            return is_glim_text(text.read(64))
    except OSError:
        return False


def read_glim(path: Path, left: LeftOut) -> tuple[Batch, tuple[I64, ...]]:
    """(the graph, the turn of each factor for each group of factors).  Raises FormatError."""
    folder = path if path.is_dir() else path.parent
    index = read_index(folder / GRAPH_TEXT)
    submaps = {number: read_submap(folder, number) for number in index.submaps}
    factors = archived_factors(folder / GRAPH_BINARY, {symbol("x", number) for number in submaps}, left)
    edges = factor_edges(factors)
    edges += _matched(index, submaps, len(factors), left)
    edges += _followed(submaps, edges, left)
    _say_frames(submaps, left)

    keys = np.array([symbol("x", number) for number in submaps], np.int64)
    values = np.array([submap.T_world_origin for submap in submaps.values()])
    vertices = [VertexColumns("se3", np.zeros(len(keys), np.int64), keys, values)]
    held = np.array([factor.keys[0] for factor in factors if factor.name == DAMPING], np.int64)
    fixes = (held, np.zeros(len(held), np.int64)) if held.size else None
    batch, turns = assembled(left.file, True, False, vertices, edges, fixes)
    return _stamped(batch, submaps), turns


def _matched(index: GlimIndex, submaps: dict[int, Submap], turn: int, left: LeftOut) -> list[EdgeColumns]:
    """Pairs of submaps that GLIM matches, as the relative poses that it has found.  Raises FormatError when strict."""
    if not index.costs:
        return []
    if left.strict:
        left.drop("matching_cost", len(index.costs), "of which the relative pose that GLIM has found is read")
    methods = ", ".join(sorted({cost.method or "unnamed" for cost in index.costs}))
    left.say(
        f"{counted(len(index.costs), 'matching_cost')} ({methods}) read as the relative pose of the two submaps that "
        "GLIM has found, with sigmas of 1 mm and 1 mrad: what it measures is in the point clouds"
    )
    ends = np.array([(cost.first, cost.second) for cost in index.costs], np.int64)
    first, second = (np.array([submaps[number].T_world_origin for number in end]) for end in ends.T.tolist())
    return [_relative(ends, compose_poses(inverse_poses(first), second), turn)]


def _followed(submaps: dict[int, Submap], edges: Iterable[EdgeColumns], left: LeftOut) -> list[EdgeColumns]:
    """Odometry from a submap to the next where nothing else joins them."""
    parts = _Parts(submaps)
    turn = 0
    for group in edges:
        turn = max(turn, int(group.lines.max()) + 1)
        if group.ids.shape[1] == 2:
            for one, other in (group.ids - symbol("x", 0)).tolist():
                parts.join(one, other)
    numbers = list(submaps)
    pairs = [
        (one, other)
        for one, other in pairwise(numbers)
        if _is_next(submaps[one], submaps[other]) and parts.join(one, other)
    ]
    if not pairs:
        return []
    left.say(
        f"{counted(len(pairs), 'submap')} that nothing joins to earlier ones placed by odometry, with sigmas of 1 mm "
        "and 1 mrad"
    )
    poses = [_odometry(submaps[one], submaps[other]) for one, other in pairs]
    return [_relative(np.array(pairs, np.int64), np.concatenate(poses), turn)]


class _Parts:
    """Which submaps hang together."""

    def __init__(self, numbers: Iterable[int]) -> None:
        self._parents = {number: number for number in numbers}

    def join(self, one: int, other: int) -> bool:
        """Whether they were apart, which they are no longer."""
        one, other = self._root(one), self._root(other)
        self._parents[max(one, other)] = min(one, other)
        return one != other

    def _root(self, number: int) -> int:
        while (parent := self._parents[number]) != number:
            self._parents[number] = number = self._parents[parent]
        return number


def _is_next(one: Submap, other: Submap) -> bool:
    """Whether they are of one drive: frames of another session begin anew."""
    if one.stamp is None or other.stamp is None:
        return False
    return one.right_id <= other.left_id and one.stamp <= other.stamp


def _odometry(one: Submap, other: Submap) -> F64:
    """The pose of a submap in the one before it, as GLIM places it at first (1, 7)."""
    T_between = compose_poses(inverse_poses(one.T_odom_right[None]), other.T_odom_left[None])
    T_origin_left = compose_poses(one.T_origin_right[None], T_between)
    return compose_poses(T_origin_left, inverse_poses(other.T_origin_left[None]))


def _relative(ends: I64, measured: F64, turn: int) -> EdgeColumns:
    """Relative poses of submaps, in turn, with the weight that GLIM gives where it knows no covariance."""
    information = doubled_rotations(packed_upper(np.tile(_UNKNOWN_COVARIANCE * np.eye(6), (len(ends), 1, 1))))
    return EdgeColumns("between_se3", turn + np.arange(len(ends)), ends + symbol("x", 0), measured, information)


def _say_frames(submaps: dict[int, Submap], left: LeftOut) -> None:
    frames = sum(submap.frames for submap in submaps.values())
    sensor = "IMU" if any(submap.is_imu for submap in submaps.values()) else "lidar"
    if frames:
        left.say(
            f"{counted(len(submaps), 'submap')} of {counted(frames, 'frame')}, each the pose of the {sensor} at its "
            "middle frame; all frames are in traj_lidar.txt, a TUM trajectory"
        )


def _stamped(batch: Batch, submaps: dict[int, Submap]) -> Batch:
    stamps = {symbol("x", number): submap.stamp for number, submap in submaps.items() if submap.stamp is not None}
    groups = []
    for group in batch.variables:
        times = np.array([stamps.get(key, NO_STAMP) for key in group.keys.tolist()], np.int64)
        groups.append(group._replace(stamps=times) if (times != NO_STAMP).any() else group)
    return Batch(tuple(groups), batch.factors)
