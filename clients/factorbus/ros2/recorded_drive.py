"""What a robot's recording comes to as a map: one insert after the other, as the bridge would have sent them."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factorbus.proto.messages import Batch
from factorbus.proto.roles import poses_aside
from factorbus.ros2.front_end import FrontEnd
from factorbus.ros2.messages import FORMER_NAMES, TRANSFORMS
from factorbus.ros2.problems import BadRecording, BadRosMessage
from factorbus.ros2.recorded_topics import frame_topics, with_topics
from factorbus.ros2.recording import Recorded, RobotRecording
from factorbus.ros2.settings import Settings
from factorbus.wording import counted

_SHOWN_EACH = 1000  # messages


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


def read_recording(
    path: Path, settings: Settings, strict: bool = False, show: Callable[[int, int], None] = lambda *_: None
) -> RecordedDrive:
    """The drive in a recording.

    settings: as a bridge has them; an odometry of "" is found by its type, and so are landmarks where none are named.
    strict: refuse what would be left out.  show: called now and then with how many messages are read, of how many; 0
    where the recording does not say.
    Raises BadRecording: it cannot be read, has no odometry, or, where `strict`, something in it was not used.
    """
    with RobotRecording(path) as recording:
        settings, notes = with_topics(recording, settings)
        made = _Reading(recording, settings)
        made.read(show)
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
        self._statics = frame_topics(recording, settings)
        self._front_end = FrontEnd(settings, 0, (), settings.start == "pose")
        self.steps, self.used, self.left_out = RecordedSteps(), Counter[str](), Counter[str]()
        self._why: dict[str, str] = {}
        self._remarks: dict[tuple[str, str], int] = {}

    def read(self, show: Callable[[int, int], None]) -> None:
        """All of it; where sensors are comes first, whenever it was said."""
        total = sum(topic.count for topic in self._recording.topics if topic.name in self._inputs)
        for message in self._recording.messages(self._statics) if self._statics else ():
            self._hear(message)
        for number, message in enumerate(self._recording.messages(list(self._inputs)), 1):
            if number % _SHOWN_EACH == 0:
                show(number, total)
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
