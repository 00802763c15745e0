"""What a robot's recording comes to as a map: one insert after the other, as the bridge would have sent them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from factorbus.proto.messages import Batch
from factorbus.ros2.front_end import FrontEnd
from factorbus.ros2.geometry import Transform, from_quaternion
from factorbus.ros2.messages import DETECTIONS, ODOMETRY, POSE, TRANSFORMS
from factorbus.ros2.problems import BadRecording, BadRosMessage
from factorbus.ros2.recording import RecordedTopic, RobotRecording
from factorbus.ros2.settings import Settings
from factorbus.wording import counted

_STATIC = "tf_static"
_SHOWN = 8  # topics in a message


class RecordedSteps(list[Batch]):
    """The inserts.  times_ns: of the last odometry before each, of the recording."""

    def __init__(self) -> None:
        super().__init__()
        self.times_ns: list[int] = []

    @property
    def poses(self) -> int:
        """Number of poses in all of them."""
        return sum(len(group.keys) for batch in self for group in batch.variables if group.kind in ("se2", "se3"))


@dataclass(frozen=True, slots=True)
class RecordedDrive:
    """The steps of a recording, and what was assumed, left out or could not be read, for people.

    used: messages by topic; left_out: those that were not, by topic.  log, numbering: as of a graph file that has none.
    """

    path: str
    steps: RecordedSteps
    notes: tuple[str, ...]
    used: Mapping[str, int]
    left_out: Mapping[str, int]
    log: None = None
    numbering: str = "ids"

    def summary(self) -> dict[str, object]:
        """A program's summary of how the recording was read."""
        read = {"used": dict(self.used), "left_out": dict(self.left_out)}
        return {"dialect": "recording", "notes": list(self.notes), **read}


def read_recording(path: Path, settings: Settings, strict: bool = False) -> RecordedDrive:
    """The drive in a recording.

    settings: as a bridge has them; an odometry of "" is found by its type, and so are landmarks where none are named.
    strict: refuse what would be left out.
    Raises BadRecording: it cannot be read, has no odometry, or, where `strict`, something in it was not used.
    """
    with RobotRecording(path) as recording:
        settings, notes = _with_topics(recording, settings)
        settings = replace(settings, mounts={**_mounts(recording, settings), **settings.mounts})
        made = _Reading(recording, settings)
        made.read()
        notes += [*recording.notes, *made.notes()]
    if strict and (made.left_out or recording.notes):
        raise BadRecording(path, next(iter([*recording.notes, *made.notes()])), "a recording that is used whole")
    if not made.steps:
        raise BadRecording(path, "; ".join(made.notes()) or "no odometry in it", "odometry to drive by")
    return RecordedDrive(str(path), made.steps, tuple(notes), made.used, made.left_out)


class _Reading:
    """Message after message through a front end."""

    def __init__(self, recording: RobotRecording, settings: Settings) -> None:
        self._recording, self._settings = recording, settings
        self._front_end = FrontEnd(settings, 0, (), settings.start == "pose")
        self.steps, self.used, self.left_out = RecordedSteps(), Counter[str](), Counter[str]()
        self._why: dict[str, str] = {}
        self._remarks: dict[tuple[str, str], int] = {}

    def read(self) -> None:
        """All of it."""
        settings, front_end = self._settings, self._front_end
        for message in self._recording.messages([settings.odometry, *settings.poses, *settings.landmarks]):
            try:
                try:
                    read = self._recording.read(message)
                except Exception as fault:  # whatever the bytes lead to
                    found = f"{counted(len(message.data), 'byte')} that cannot be read ({fault})"
                    raise BadRosMessage(message.topic, found, f"a {message.type_name}") from None
                draft = self._take(message.topic, read)
            except BadRosMessage as bad:
                self._leave_out(bad, message.topic)
            else:
                self.used[message.topic] += 1
                if draft is not None:
                    self.steps.append(draft.batch())
                    self.steps.times_ns.append(front_end.stamp_ns)
            for bad in front_end.refused:
                topic = str(bad.detail["topic"])
                self.used[topic] -= 1
                self._leave_out(bad, topic)
            for remark in front_end.remarks:
                self._remarks[remark] = self._remarks.get(remark, 0) + 1
            front_end.refused.clear()
            front_end.remarks.clear()

    def notes(self) -> list[str]:
        """What was not used and why, and what was taken otherwise than it came."""
        left = [
            f"{topic}: {counted(count, 'message')} not used; the first: {self._why[topic]}"
            for topic, count in self.left_out.items()
        ]
        return left + [f"{topic}: {remark} ({counted(n, 'time')})" for (topic, remark), n in self._remarks.items()]

    def _take(self, topic: str, read: Any) -> Any:
        if read.header.stamp.sec == read.header.stamp.nanosec == 0:
            raise BadRosMessage(topic, "a stamp of 0, as of a driver that sets none", "the time of the measurement")
        if topic == self._settings.odometry:
            return self._front_end.odometry(read)
        if topic in self._settings.poses:
            return self._front_end.pose(topic, read)
        return self._front_end.detections(topic, read)

    def _leave_out(self, bad: BadRosMessage, topic: str) -> None:
        self.left_out[topic] += 1
        self._why.setdefault(topic, f"{bad.detail['seen']}; wanted {bad.detail['wanted']}")


def _with_topics(recording: RobotRecording, settings: Settings) -> tuple[Settings, list[str]]:
    """The topics to read, those not named by their types, and what was chosen.  Raises BadRecording."""
    _check_named(recording, ODOMETRY, [settings.odometry] if settings.odometry else [])
    _check_named(recording, POSE, settings.poses)
    _check_named(recording, DETECTIONS, settings.landmarks)
    notes = []
    if not settings.odometry:
        settings, note = _with_odometry(recording, settings)
        notes.append(note)
    if not settings.landmarks and (found := _of_type(recording, DETECTIONS)):
        found, others = _of_this_robot(recording, settings, found)
        settings = replace(settings, landmarks=tuple(topic.name for topic in found))
        if found:
            notes.append(f"landmarks: {_listed(found)}")
        if others:
            takes = " ".join(f"--landmarks {topic.name}" for topic in others)
            notes.append(f"landmarks of another robot left out: {_listed(others)}; {takes} takes them")
    if not settings.poses and (found := _of_type(recording, POSE)):
        takes = " ".join(f"--pose {topic.name}" for topic in found)
        notes.append(f"poses left out: {_listed(found)}; {takes} takes them, and --start pose begins with the first")
    return settings, notes


def _check_named(recording: RobotRecording, type_name: str, names: Sequence[str]) -> None:
    """Raises BadRecording: a topic that was named is not there, or has messages of another type."""
    topics = {topic.name: topic.type_name for topic in recording.topics}
    for name in names:
        if name not in topics:
            raise BadRecording(recording.path, f"no topic {name}", f"one of {_listed(recording.topics)}")
        if topics[name] != type_name:
            there = _listed(_of_type(recording, type_name)) or "none"
            wanted = f"a topic of {type_name} (there is {there})"
            raise BadRecording(recording.path, f"{name} is of {topics[name]}", wanted)


def _of_this_robot(
    recording: RobotRecording, settings: Settings, found: Sequence[RecordedTopic]
) -> tuple[list[RecordedTopic], list[RecordedTopic]]:
    """(topics of the robot whose odometry is read, those of others).

    Robots are told apart by the first part of names, where each has an odometry that is called the same behind it.
    """
    mine, name = _namespaced(settings.odometry)
    robots = {_namespaced(topic.name)[0] for topic in _of_type(recording, ODOMETRY) if topic.name.endswith(f"/{name}")}
    others = robots - {mine} if mine else set[str]()
    theirs = [topic for topic in found if _namespaced(topic.name)[0] in others]
    return [topic for topic in found if topic not in theirs], theirs


def _namespaced(topic: str) -> tuple[str, str]:
    """("/robot1", "odom") of /robot1/odom; ("", "odom") of /odom."""
    first, _, rest = topic.removeprefix("/").partition("/")
    return (f"/{first}", rest) if rest else ("", first)


def _with_odometry(recording: RobotRecording, settings: Settings) -> tuple[Settings, str]:
    """With the odometry of the recording: /odom, else one that ends so, else the one with most messages."""
    found = _of_type(recording, ODOMETRY)
    if not found:
        wanted = f"a topic of {ODOMETRY}; it has {_listed(recording.topics) or 'no topic'}"
        raise BadRecording(recording.path, "no odometry", wanted)
    best = max(found, key=lambda topic: (topic.name == "/odom", topic.name.endswith("odom"), topic.count))
    others = f" (of {_listed(found)}; --odom decides)" if len(found) > 1 else ""
    return replace(settings, odometry=best.name), f"odometry: {best.name}{others}"


def _of_type(recording: RobotRecording, type_name: str) -> list[RecordedTopic]:
    return [topic for topic in recording.topics if topic.type_name == type_name]


def _listed(topics: Sequence[RecordedTopic]) -> str:
    more = f" and {len(topics) - _SHOWN} more" if len(topics) > _SHOWN else ""
    return ", ".join(topic.name for topic in topics[:_SHOWN]) + more


def _mounts(recording: RobotRecording, settings: Settings) -> dict[str, Transform]:
    """T_base_frame of all frames that a tf_static, that of all or the robot's own, joins to odometry's base frame."""
    edges: dict[str, dict[str, Transform]] = {}
    of_robot = (f"/{_STATIC}", f"{_namespaced(settings.odometry)[0]}/{_STATIC}")
    statics = [topic.name for topic in _of_type(recording, TRANSFORMS) if topic.name in of_robot]
    for message in recording.messages(statics) if statics else ():
        try:
            transforms = recording.read(message).transforms
        except Exception:  # whatever the bytes lead to: without them a mount has to be given
            continue
        for each in transforms:
            if (there := _transform(each.transform)) is not None:
                parent, child = each.header.frame_id, each.child_frame_id
                edges.setdefault(parent, {})[child] = there
                edges.setdefault(child, {})[parent] = there.inverse()
    base = _base_frame(recording, settings)
    found, ahead = {base: Transform(np.eye(3), np.zeros(3))}, [base]
    while ahead:
        frame = ahead.pop()
        for other, there in edges.get(frame, {}).items():
            if other not in found:
                found[other] = found[frame] @ there
                ahead.append(other)
    return found


def _base_frame(recording: RobotRecording, settings: Settings) -> str:
    """The frame that odometry is of, by its first message."""
    for message in recording.messages([settings.odometry]):
        try:
            return str(recording.read(message).child_frame_id)
        except Exception:  # whatever the bytes lead to
            continue
    return ""


def _transform(transform: Any) -> Transform | None:
    """None: no turn that can be."""
    t, q = transform.translation, transform.rotation
    try:
        return from_quaternion((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))
    except ValueError:
        return None
