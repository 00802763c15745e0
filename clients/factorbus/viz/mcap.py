"""A map as an MCAP recording that Foxglove opens: what to draw, what to plot, and every estimate and factor as numbers.

| topic | schema | |
|---|---|---|
| /tf | foxglove.FrameTransform | map → robot: the pose with the largest key, one for each letter, at its time stamp |
| /map/scene | foxglove.SceneUpdate | trajectory, landmarks, loop closures coloured by how badly they fit |
| /map/poses | foxglove.PosesInFrame | all poses |
| /map/step | factorbus.Step, JSON | the report of each step, for plots: chi2, step_ms, eliminated, … |
| /map/delta | factorbus.Delta, protobuf | each delta, whole: variables by kind, keys, values and time stamps |
| /map/factors | factorbus.Factors, protobuf | factors when they were first seen, by kind: keys, measured, information |

Messages are logged at the time at which they are written.  A time stamp is in nanoseconds, of a variable without one
−2⁶³.  A pose without, or with one that MCAP has no place for, is in /tf at the log time.
"""

import math
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import foxglove
import numpy as np
from foxglove import messages as fox
from foxglove.channels import FrameTransformChannel, PosesInFrameChannel, SceneUpdateChannel

from factorbus.proto.arrays import F64
from factorbus.proto.messages import Delta, Factors, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import symbol_parts
from factorbus.viz.map_follower import Look
from factorbus.viz.mcap_numbers import NumberChannels
from factorbus.viz.mcap_scene import scene_of

_BEYOND_NS = 2**32 * 10**9  # MCAP's seconds are 32 bits without a sign
_STEP = {
    "title": "factorbus.Step",
    "type": "object",
    "properties": {name: {"type": "number"} for name in ("epoch", "revision", "chi2", "step_ms", "changed")}
    | {name: {"type": "string"} for name in ("strategy", "because")},
}


class Recording:
    """An MCAP file that is written, look by look.  Use it in `with`.  Raises FileExistsError.

    with_deltas: also the estimate after each step and the factors, as numbers
    """

    def __init__(self, path: str | os.PathLike[str], with_deltas: bool = True) -> None:
        self._context = context = foxglove.Context()  # channels do not keep it alive
        self._writer = foxglove.open_mcap(os.fspath(path), context=context)
        self._tf = FrameTransformChannel("/tf", context=context)
        self._scene = SceneUpdateChannel("/map/scene", context=context)
        self._poses = PosesInFrameChannel("/map/poses", context=context)
        self._step = foxglove.Channel("/map/step", schema=_STEP, context=context)
        self._numbers = NumberChannels(context) if with_deltas else None
        self._seen: dict[str, int] = {}
        self._epoch = 0
        self.deltas = self.factors = self.revision = 0

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def begin(self, look: Look) -> None:
        """Write what is there before the first delta, as one that brings everything."""
        if not look.deltas:
            whole = Delta(look.epoch, look.revision, 0, look.variables)
            look = replace(look, deltas=(whole,))
        self.take(look)

    def take(self, look: Look, now_ns: int | None = None) -> None:
        """Write what is new in `look`."""
        now_ns = time.time_ns() if now_ns is None else now_ns
        if look.epoch != self._epoch:
            self._seen, self._epoch = {}, look.epoch
        self.revision = look.revision
        for delta in look.deltas:
            self._take_delta(delta, now_ns)
        for group in look.factors:
            self._take_factors(look, group, now_ns)
        stamp = fox.Timestamp(now_ns // 10**9, now_ns % 10**9)
        for key, value, own_ns in _last_poses(look.variables):
            name, known = symbol_parts(key)[0] or "robot", 0 <= own_ns < _BEYOND_NS
            at = fox.Timestamp(own_ns // 10**9, own_ns % 10**9) if known else stamp
            self._tf.log(_transform(name, value, at), log_time=now_ns)
        self._poses.log(_poses_in_frame(look.variables, stamp), log_time=now_ns)
        self._scene.log(scene_of(look, stamp), log_time=now_ns)

    def _take_delta(self, delta: Delta, now_ns: int) -> None:
        at = {"epoch": delta.epoch, "revision": delta.revision}
        numbers = {k: v for k, v in delta.report.items() if isinstance(v, (int, float, str)) and _finite(v)}
        self._step.log(at | numbers, log_time=now_ns)
        if self._numbers is not None:
            self._numbers.write_delta(delta, now_ns)
        self.deltas += 1

    def _take_factors(self, look: Look, group: Factors, now_ns: int) -> None:
        """The factors of a kind come in the order of their ids: what is behind those seen before is new."""
        first = self._seen.get(group.kind, 0)
        if first >= len(group.keys):
            return
        self._seen[group.kind] = len(group.keys)
        self.factors += len(group.keys) - first
        if self._numbers is not None:
            new = group._replace(
                keys=group.keys[first:], measured=group.measured[first:], information=group.information[first:]
            )
            self._numbers.write_factors(look.epoch, look.factors_revision, new, now_ns)


def _finite(value: Any) -> bool:
    return isinstance(value, str) or math.isfinite(value)


def _last_poses(variables: Sequence[Variables]) -> list[tuple[int, F64, int]]:
    """(key, x y z qx qy qz qw, time stamp or NO_STAMP) of the pose with the largest index, for each letter."""
    last: dict[str, tuple[int, F64, int]] = {}
    for group in variables:
        if group.kind in ("se2", "se3", "sim3") and group.values is not None:
            stamps = np.full(group.keys.size, NO_STAMP) if group.stamps is None else group.stamps
            for key, value, stamp in zip(group.keys.tolist(), group.values, stamps.tolist(), strict=True):
                letter = symbol_parts(key)[0]
                if letter not in last or key > last[letter][0]:
                    last[letter] = (key, value, stamp)
    return [(key, lifted(value), stamp) for key, value, stamp in last.values()]


def lifted(value: F64) -> F64:
    """A pose (3,), (7,) or, with a scale, (8,) as x y z qx qy qz qw."""
    if len(value) >= 7:
        return value[:7]
    x, y, theta = value
    return np.array([x, y, 0.0, 0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2)])


def _transform(name: str, pose: F64, stamp: fox.Timestamp) -> fox.FrameTransform:
    x, y, z, qx, qy, qz, qw = pose.tolist()
    return fox.FrameTransform(
        timestamp=stamp,
        parent_frame_id="map",
        child_frame_id=name,
        translation=fox.Vector3(x=x, y=y, z=z),
        rotation=fox.Quaternion(x=qx, y=qy, z=qz, w=qw),
    )


def _poses_in_frame(variables: Sequence[Variables], stamp: fox.Timestamp) -> fox.PosesInFrame:
    poses = []
    for group in variables:
        if group.kind in ("se2", "se3", "sim3") and group.values is not None:
            for value in group.values:
                x, y, z, qx, qy, qz, qw = lifted(value).tolist()
                here, turned = fox.Vector3(x=x, y=y, z=z), fox.Quaternion(x=qx, y=qy, z=qz, w=qw)
                poses.append(fox.Pose(position=here, orientation=turned))
    return fox.PosesInFrame(timestamp=stamp, frame_id="map", poses=poses)
