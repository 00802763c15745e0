"""Where sensors are on a robot: what /tf_static says, and what was given by hand, which counts first."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from factorbus.ros2.geometry import Transform
from factorbus.ros2.message_parts import frame_name, transform_of
from factorbus.ros2.problems import BadRosMessage

_FRAMES = 4096  # that are kept


class Mounts:
    """T_base_frame of the frames that static transforms join to the base frame.  given: of some, by hand."""

    def __init__(self, given: Mapping[str, Transform]) -> None:
        self._given = {frame_name(frame): there for frame, there in given.items()}
        self._edges: dict[str, dict[str, Transform]] = {}
        self._found: dict[str, dict[str, Transform]] = {}

    def hear(self, topic: str, message: Any) -> None:
        """A tf2_msgs/TFMessage of /tf_static.  Raises BadRosMessage: of one or more transforms, the others are kept."""
        self._found = {}
        bad: list[BadRosMessage] = []
        for each in message.transforms:
            parent, child = frame_name(each.header.frame_id), frame_name(each.child_frame_id)
            try:
                there = transform_of(topic, each.transform)
                if len(self._edges) >= _FRAMES and not {parent, child} <= self._edges.keys():
                    raise BadRosMessage(topic, f"more than {_FRAMES} frames", f"{_FRAMES} at most")
            except BadRosMessage as problem:
                bad.append(problem)
                continue
            self._edges.setdefault(parent, {})[child] = there
            self._edges.setdefault(child, {})[parent] = there.inverse()
        if bad:
            raise bad[0]

    def try_mount(self, base: str, frame: str) -> Transform | None:
        """T_base_frame, if it is known."""
        frame = frame_name(frame)
        if frame in self._given:
            return self._given[frame]
        if base not in self._found:
            self._found[base] = self._joined(base)
        return self._found[base].get(frame)

    def _joined(self, base: str) -> dict[str, Transform]:
        found, ahead = {base: Transform(np.eye(3), np.zeros(3))}, [base]
        while ahead:
            frame = ahead.pop()
            for other, there in self._edges.get(frame, {}).items():
                if other not in found:
                    found[other] = found[frame] @ there
                    ahead.append(other)
        return found
