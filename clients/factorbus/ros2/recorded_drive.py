"""What a robot's recording comes to as a map: one insert after the other, as the bridge would have sent them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from factorbus.proto.messages import Batch
from factorbus.proto.roles import poses_aside
from factorbus.ros2.front_end import FrontEnd
from factorbus.ros2.messages import (
    DETECTIONS,
    FIX,
    FORMER_NAMES,
    IMU,
    LANDMARK_LIST,
    LINK,
    MAP_GRAPH,
    ODOMETRY,
    POSE,
    POSE_GRAPH,
    TAGS,
    TRANSFORMS,
)  # fmt: skip
from factorbus.ros2.problems import BadRecording, BadRosMessage
from factorbus.ros2.recording import Recorded, RecordedTopic, RobotRecording
from factorbus.ros2.settings import STATIC, Settings
from factorbus.wording import counted

_SHOWN = 8  # topics in a message
_OPTIONS = {"landmark_lists": "landmark-list"}


class RecordedSteps(list[Batch]):
    """The inserts.  times_ns: of the last odometry before each, of the recording."""

    def __init__(self) -> None:
        super().__init__()
        self.times_ns: list[int] = []

    @property
    def poses(self) -> int:
        """Number of poses in all of them; GNSS's frame is none."""
        found = (len(group.keys) for batch in self for group in batch.variables if group.kind in ("se2", "se3"))
        return sum(found) - len({key for batch in self for key in poses_aside(batch).tolist()})


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
        self._recording, self._inputs = recording, settings.inputs()
        names = _frames_of(settings)
        self._statics = [topic.name for topic in _of_type(recording, TRANSFORMS) if topic.name in names]
        self._front_end = FrontEnd(settings, 0, (), settings.start == "pose")
        self.steps, self.used, self.left_out = RecordedSteps(), Counter[str](), Counter[str]()
        self._why: dict[str, str] = {}
        self._remarks: dict[tuple[str, str], int] = {}

    def read(self) -> None:
        """All of it; where sensors are comes first, whenever it was said."""
        for message in self._recording.messages(self._statics) if self._statics else ():
            self._hear(message)
        for message in self._recording.messages(list(self._inputs)):
            if (draft := self._hear(message)) is not None:
                self.steps.append(draft.batch())
                self.steps.times_ns.append(self._front_end.stamp_ns)
            self._note()

    def notes(self) -> list[str]:
        """What was not used and why, and what was taken otherwise than it came."""
        left = [
            f"{topic}: {counted(count, 'message')} not used; the first: {self._why[topic]}"
            for topic, count in self.left_out.items()
        ]
        left += [f"{topic}: {remark} ({counted(n, 'time')})" for (topic, remark), n in self._remarks.items()]
        return left + [f"{topic}: {text}" for topic, text in self._front_end.open_ends()]

    def _hear(self, message: Recorded) -> Any:
        """The draft that comes of a message, if one does."""
        topic = message.topic
        try:
            try:
                read = self._recording.read(message)
            except Exception as fault:  # whatever the bytes lead to
                found = f"{counted(len(message.data), 'byte')} that cannot be read ({fault})"
                raise BadRosMessage(topic, found, f"a {message.type_name}") from None
            wanted = self._inputs.get(topic, TRANSFORMS)
            if FORMER_NAMES.get(message.type_name, message.type_name) != wanted:
                raise BadRosMessage(topic, f"a {message.type_name}", f"a {wanted}")
            if topic in self._statics:
                self._front_end.static(topic, read)
                return None
            if (header := getattr(read, "header", None)) and header.stamp.sec == header.stamp.nanosec == 0:
                raise BadRosMessage(topic, "a stamp of 0, as of a driver that sets none", "the time of the measurement")
            draft = self._front_end.take(topic, self._inputs[topic], read)
        except BadRosMessage as bad:
            self._leave_out(bad, topic)
            return None
        self.used[topic] += 1
        return draft

    def _note(self) -> None:
        """What the front end has said since."""
        front_end = self._front_end
        for bad in front_end.refused:
            topic = str(bad.detail["topic"])
            if bad.of_message:
                self.used[topic] -= 1
            self._leave_out(bad, topic if bad.of_message else f"{topic} (edges)")
        for remark in front_end.remarks:
            self._remarks[remark] = self._remarks.get(remark, 0) + 1
        front_end.refused.clear()
        front_end.remarks.clear()

    def _leave_out(self, bad: BadRosMessage, topic: str) -> None:
        self.left_out[topic] += 1
        self._why.setdefault(topic, f"{bad.detail['seen']}; wanted {bad.detail['wanted']}")


def _with_topics(recording: RobotRecording, settings: Settings) -> tuple[Settings, list[str]]:
    """The topics to read, those not named by their types, and what was chosen.  Raises BadRecording."""
    for name, type_name in settings.inputs().items():
        _check_named(recording, type_name, name)
    notes = []
    if not settings.odometry:
        settings, note = _with_odometry(recording, settings)
        notes.append(note)
    for with_more in (_with_landmarks, _with_graphs_and_fixes):
        settings, more = with_more(recording, settings)
        notes += more
    if not settings.poses and (found := _of_type(recording, POSE)):
        takes = " ".join(f"--pose {topic.name}" for topic in found)
        notes.append(f"poses left out: {_listed(found)}; {takes} takes them, and --start pose begins with the first")
    names = _frames_of(settings)
    if found := [topic for topic in _of_type(recording, TRANSFORMS) if topic.name.endswith(STATIC)]:
        others = [topic for topic in found if topic.name not in names]
        if others:
            notes.append(f"frames of sensors left out: {_listed(others)}; those of {' and '.join(names)} are read")
    if recording.unread:
        shown = ", ".join(recording.unread[:_SHOWN])
        notes.append(f"left out, as the form of their messages is not known or not one: {shown}")
    if not settings.imu and (found := _of_type(recording, IMU)):
        takes = f"--space --imu {found[0].name} takes its raw samples"
        notes.append(f"IMU left out: {_listed(found)}; {takes}, where odometry was not made of them already")
    return settings, notes


def _with_landmarks(recording: RobotRecording, settings: Settings) -> tuple[Settings, list[str]]:
    """With this robot's observations, of all types that are not named."""
    notes = []
    for name, type_name in (("landmarks", DETECTIONS), ("landmark_lists", LANDMARK_LIST), ("tags", TAGS)):
        if getattr(settings, name) or not (found := _of_type(recording, type_name)):
            continue
        found, others = _of_this_robot(recording, settings, found)
        settings = replace(settings, **{name: tuple(topic.name for topic in found)})
        if found:
            notes.append(f"landmarks: {_listed(found)}" + ("" if type_name == DETECTIONS else f" ({type_name})"))
        if others:
            takes = " ".join(f"--{_OPTIONS.get(name, name)} {topic.name}" for topic in others)
            notes.append(f"landmarks of another robot left out: {_listed(others)}; {takes} takes them")
    return settings, notes


def _with_graphs_and_fixes(recording: RobotRecording, settings: Settings) -> tuple[Settings, list[str]]:
    """With all graphs of a front end that are not named, and one receiver of GNSS."""
    notes = []
    for name, type_name in (("pose_graphs", POSE_GRAPH), ("map_graphs", MAP_GRAPH), ("links", LINK)):
        if not getattr(settings, name) and (found := _of_type(recording, type_name)):
            settings = replace(settings, **{name: tuple(topic.name for topic in found)})
            notes.append(f"closures: {_listed(found)} ({type_name})")
    if not settings.fixes and (found := _of_type(recording, FIX)):
        # What a filter publishes in the form of a fix was made of odometry, too.
        best = max(found, key=lambda topic: (topic.name.endswith("fix"), "filtered" not in topic.name, topic.count))
        others = f" (of {_listed(found)}; --fix decides)" if len(found) > 1 else ""
        settings = replace(settings, fixes=(best.name,))
        notes.append(f"GNSS: {best.name}{others}")
    return settings, notes


def _check_named(recording: RobotRecording, type_name: str, name: str) -> None:
    """Raises BadRecording: a topic that was named is not there, or has messages of another type."""
    topics = {topic.name: topic for topic in recording.topics}
    if name not in topics:
        raise BadRecording(recording.path, f"no topic {name}", f"one of {_listed(recording.topics)}")
    if _type_of(topics[name]) != type_name:
        there = _listed(_of_type(recording, type_name)) or "none"
        wanted = f"a topic of {type_name} (there is {there})"
        raise BadRecording(recording.path, f"{name} is of {topics[name].type_name}", wanted)


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


def _frames_of(settings: Settings) -> list[str]:
    """Topics of where sensors are: of all robots, and of this one."""
    return list(dict.fromkeys((STATIC, _namespaced(settings.odometry)[0] + STATIC)))


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
    return [topic for topic in recording.topics if _type_of(topic) == type_name]


def _type_of(topic: RecordedTopic) -> str:
    """Its type by the present name."""
    return FORMER_NAMES.get(topic.type_name, topic.type_name)


def _listed(topics: Sequence[RecordedTopic]) -> str:
    more = f" and {len(topics) - _SHOWN} more" if len(topics) > _SHOWN else ""
    return ", ".join(topic.name for topic in topics[:_SHOWN]) + more
