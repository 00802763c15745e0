"""A robot on ROS 2 and a map of ours, joined: messages in on one thread, the correction out on the mirror's, the pose
with its covariance, which is asked for, on a third, and pictures on a fourth."""

import logging
import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any

from factorbus.client import Draft, Map, PendingInsert, Problem, Refused, Snapshot, Unavailable
from factorbus.proto.arrays import F64
from factorbus.proto.messages import Delta
from factorbus.proto.symbols import symbol
from factorbus.ros2 import display
from factorbus.ros2.front_end import FrontEnd
from factorbus.ros2.geometry import Transform
from factorbus.ros2.inertial import first_of_letter
from factorbus.ros2.messages import LATEST_S, MARKERS, ODOMETRY, PATH, POSE, TRANSFORMS, Messages
from factorbus.ros2.names import Topic
from factorbus.ros2.node import Node, Publisher
from factorbus.ros2.problems import BadRosMessage, Unusable
from factorbus.ros2.settings import FRAME_LETTER, GRAVITY_LETTER, STATIC, Settings
from factorbus.ros2.smoothing import SmoothedCorrection
from factorbus.ros2.space import SPACES

log = logging.getLogger("factorbus.ros2")

# Messages that may wait to be read; the next ones are dropped and counted.  Odometry is absolute, so little is lost.
_BACKLOG = 4096
_IDLE_S = 0.2
# Drawing may take this share of the time, and asking how certain the pose is that.
_DRAWING, _ASKING = 0.05, 0.5
_OTHER_MAP = ("wrong_epoch", "unknown_map")
_STATIC_DEPTH = 100  # transforms that each publisher of them keeps for those who come late
_REMARKS = 1000  # different ones that are logged


class Bridge:
    """Reads from the moment it is made until `run` returns.  The map and the node stay the caller's."""

    def __init__(self, joined: Map, node: Node, messages: Messages, settings: Settings) -> None:
        self._map, self._messages, self._settings = joined, messages, settings
        self._inbox: queue.Queue[tuple[str, str, bytes]] = queue.Queue(_BACKLOG)
        self._out: deque[PendingInsert] = deque()
        self._tolerance_ns = int(1e9 * settings.tolerance_s)
        self.counts: Counter[str] = Counter()
        self._told: Counter[tuple[str, str]] = Counter()
        self._remarked: set[tuple[str, str]] = set()
        self._front_end = FrontEnd(settings, *self._place_in_map())
        self._smoothed = SmoothedCorrection(settings.smooth_s)
        self._stepped = threading.Event()  # since the last pose was published
        self._correcting = threading.Lock()  # of two threads none publishes by an older estimate than the other
        self._transforms = node.publisher(self._topic(settings.transforms, TRANSFORMS, 100))
        self._raw_transforms = (
            node.publisher(self._topic(settings.raw_transforms, TRANSFORMS, 100)) if settings.smooth_s else None
        )
        self._path = node.publisher(self._topic(settings.path, PATH, 1))
        self._markers = node.publisher(self._topic(settings.markers, MARKERS, 1))
        self._pose = node.publisher(self._topic(settings.pose, POSE, 1))
        self._forget = joined.estimate.on_delta(self._on_delta)
        # First, so that what sensors say is not read before what says where they are.
        self._listen(node, self._topic(STATIC, TRANSFORMS, _STATIC_DEPTH), kept=True)
        for name, type_name in settings.inputs().items():
            self._listen(node, self._topic(name, type_name, 10))
        if self._front_end.waits_for_pose:
            log.warning(
                "waiting for a pose on %s: %s", " or ".join(settings.poses) or "none (--pose)", self._why_wait()
            )

    def run(self, stop: threading.Event) -> None:
        """Until `stop`.  Raises what the map refuses in a way that nothing here can mend."""
        beside = [
            threading.Thread(target=work, args=(stop,), name=f"factorbus-ros2-{name}", daemon=True)
            for name, work in (("pose", self._locate), ("display", self._draw))
        ]
        for each in beside:
            each.start()
        try:
            while not stop.is_set():
                try:
                    topic, type_name, data = self._inbox.get(timeout=_IDLE_S)
                except queue.Empty:
                    self._collect()
                    continue
                self._read(stop, topic, type_name, data)
                self._collect()
        finally:
            self._forget()
            stop.set()
            for each in beside:
                each.join()

    def _listen(self, node: Node, topic: Topic, kept: bool = False) -> None:
        def hear(data: bytes) -> None:
            try:
                self._inbox.put_nowait((topic.name, topic.type, data))
            except queue.Full:
                self.counts["dropped"] += 1

        node.subscribe(topic, hear, kept)

    def _topic(self, name: str, type_name: str, depth: int) -> Topic:
        return Topic(name, type_name, self._messages.hash(type_name), depth)

    def _place_in_map(self) -> tuple[int, list[int], bool, int, int]:
        """The first index that is free, the landmarks there are, whether a pose has to be told first, and the first
        indices that are free of frames of GNSS and of gravity."""
        columns = self._map.estimate.snapshot().columns
        landmarks = columns.get(SPACES[self._settings.space].point, ([],))[0]
        waits = self._settings.start == "pose" or any(len(keys) for keys, _ in columns.values())
        first, frame = (_first_free(columns, letter) for letter in (self._settings.letter, FRAME_LETTER))
        gravity = _first_free(columns, GRAVITY_LETTER, first_of_letter(self._settings.letter))
        return first, list(map(int, landmarks)), waits, frame, gravity

    def _why_wait(self) -> str:
        return (
            "as was asked for"
            if self._settings.start == "pose"
            else "the map is not empty, and where in it we are is unknown"
        )

    def _read(self, stop: threading.Event, topic: str, type_name: str, data: bytes) -> None:
        self.counts[topic] += 1
        try:
            message = self._messages.read(topic, type_name, data)
            draft = self._draft(topic, type_name, message)
        except BadRosMessage as bad:
            self._tell(bad, topic)
            return
        except Exception as fault:
            # Whatever a driver sends, the others go on.
            if not self.counts["internal"]:
                log.exception("a message on %s could not be used", topic)
            self._tell(Unusable(topic, fault), topic)
            return
        finally:
            self._say_what_was_done()
        if draft is not None:
            self._send(stop, draft)
        elif type_name == ODOMETRY:
            self._correct()  # a step brings one by itself

    def _draft(self, topic: str, type_name: str, message: Any) -> Draft | None:
        if type_name == TRANSFORMS:
            self._front_end.static(topic, message)
            return None
        return self._front_end.take(topic, type_name, message)

    def _say_what_was_done(self) -> None:
        """With messages that waited and could not be used, and with covariances that were taken otherwise."""
        for bad in self._front_end.refused:
            self._tell(bad, str(bad.detail["topic"]))
        for topic, remark in self._front_end.remarks:
            self.counts["remarks"] += 1
            if (topic, remark) not in self._remarked and len(self._remarked) < _REMARKS:
                self._remarked.add((topic, remark))
                log.warning("%s: %s (said once)", topic, remark)
        self._front_end.refused.clear()
        self._front_end.remarks.clear()

    def _send(self, stop: threading.Event, draft: Draft) -> None:
        """Until it is on its way: while the service is away, odometry waits in the inbox."""
        while not stop.is_set():
            try:
                self._out.append(self._map.send(draft, timeout_s=1.0))
            except Unavailable as unavailable:
                self._tell(unavailable)
                continue
            except Problem as problem:  # it could not even be sent: larger than a message may be, say
                self._recover(problem)
            return

    def _collect(self) -> None:
        while self._out and self._out[0].done():
            try:
                self._out.popleft().result(0)
                self.counts["inserted"] += 1
            except Refused as refused:
                self._recover(refused)

    def _recover(self, refused: Problem) -> None:
        """Those after a refused insert lean on it: see them all answered, then go on from what is in the map."""
        log.error("the map refused an insert: %s [%s]", refused.message, refused.code)
        self.counts["refused"] += 1
        for pending_insert in self._out:
            try:
                pending_insert.result()
            except Problem as also:
                log.info("and one after it: %s [%s]", also.message, also.code)
        self._out.clear()
        if refused.code in _OTHER_MAP:
            self._map.rejoin()
            self._map.estimate.wait_for(0)
            with self._correcting:
                self._front_end.begin_again(*self._place_in_map())
                self._smoothed.forget()
        else:
            self._front_end.rewind(lambda key: key in self._map.estimate)

    def _on_delta(self, _: Delta) -> None:
        """On the mirror's thread, after a step."""
        self._correct()
        self._stepped.set()

    def _correct(self) -> None:
        mirror = self._map.estimate

        def value_of(key: int) -> F64 | None:
            try:
                return mirror[key]
            except KeyError:
                return None

        with self._correcting:
            correction, last_ns = self._front_end.try_correction(value_of), self._front_end.stamp_ns
            if correction is None:
                return
            stamp_ns = min(last_ns + self._tolerance_ns, LATEST_S * 10**9)
            self._publish_transform(self._transforms, self._smoothed.at(correction, last_ns), stamp_ns)
            if self._raw_transforms is not None:
                self._publish_transform(self._raw_transforms, correction.T_map_odom, stamp_ns)
            self.counts["transforms"] += 1

    def _publish_transform(self, to: Publisher, T_map_odom: Transform, stamp_ns: int) -> None:
        frame = self._front_end.odometry_frame
        to.publish(display.transform(self._messages, self._settings, frame, T_map_odom, stamp_ns))

    def _draw(self, stop: threading.Event) -> None:
        """Path and markers whenever the estimate has changed, as often as may be."""
        drawn, pause_s = (-1, -1), self._settings.display_s
        while not stop.wait(pause_s):
            mirror = self._map.estimate
            if drawn == (mirror.epoch, mirror.revision):
                continue
            start, snapshot, stamp_ns = time.perf_counter(), mirror.snapshot(), self._front_end.stamp_ns
            self._path.publish(display.path(self._messages, self._settings, snapshot, stamp_ns))
            self._markers.publish(display.markers(self._messages, self._settings, snapshot, stamp_ns))
            drawn = snapshot.epoch, snapshot.revision
            pause_s = max(self._settings.display_s, (time.perf_counter() - start) / _DRAWING)

    def _locate(self, stop: threading.Event) -> None:
        """The pose after every step, or after several where they come faster than answers."""
        self._stepped.set()  # of what is there
        while not stop.is_set():
            if self._stepped.wait(_IDLE_S):
                self._stepped.clear()
                start = time.perf_counter()
                self._publish_pose(self._map.estimate.snapshot())
                stop.wait((time.perf_counter() - start) * (1 / _ASKING - 1))

    def _publish_pose(self, snapshot: Snapshot) -> None:
        """The last keyframe, with the covariance that the service has of it by now."""
        key = display.last_keyframe(self._settings, snapshot)
        if key is None:
            return
        try:
            covariance = self._map.uncertainty.covariance([key])[key]
        except Problem as problem:  # the service is away, or the map another one
            self._tell(problem, self._settings.pose)
            return
        self._pose.publish(display.certain_pose(self._messages, self._settings, snapshot, key, covariance))

    def _tell(self, problem: Problem, topic: str = "") -> None:
        """The first of a kind on a topic, then every hundredth."""
        self.counts[problem.code] += 1
        self._told[problem.code, topic] += 1
        if (count := self._told[problem.code, topic]) % 100 == 1:
            log.warning("%s [%s] (%d so far)", problem.message, problem.code, count)


def _first_free(columns: Mapping[str, Any], letter: str, begin: int = 0) -> int:
    """The index after the last key of a letter, of the 2⁴⁰ from `begin` on, which it is counted from."""
    first = 0
    for keys, _ in columns.values():
        mine = keys - symbol(letter, begin)
        first = max([first, *(mine[(mine >= 0) & (mine < 1 << 40)] + 1).tolist()])
    return first
