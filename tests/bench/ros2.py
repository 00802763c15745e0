"""How long a robot on ROS 2 waits for its transform, against the same messages over bare Zenoh.

    python tests/bench/ros2.py [--rounds N] [--samples N] [--json]

The robot is this process: ROS 2 messages by another library (pycdr2), over a session of its own. It sends an odometry
that is a keyframe, and waits for the transform that comes of it. It also hears the service's delta, as anybody can:
from that to the transform is what the bridge adds to a step, and what the goal is about.

The floor has the same messages, of the same sizes, from robot to relay, relay to hub (a query), hub to all (a
publication) and relay to robot, with nothing done at any of them. Both run all the time and are asked in turn, BLOCK
exchanges each. The pose with its covariance, which the bridge asks the service for, is waited for as well.

Goal: p50 from the step's delta to the transform, and to the pose with its covariance, at most 5 ms.
"""

import argparse
import gc
import json
import os
import queue
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from bus import FLOOR, percentiles, process, session
from zenoh.handlers import Callback

from factorbus.client import Draft
from factorbus.proto import codec, keys
from factorbus.proto.messages import Insert

sys.path.insert(0, str(Path(__file__).parents[1] / "ros2"))

GOAL_MS = 5.0
BLOCK = 25
DOMAIN = 91
MAP = "bench_ros2"
STEP = (0.6, 0.0, 0.1)
RELAY = "floor/ros2"


@dataclass(frozen=True, slots=True)
class Sample:
    """Milliseconds from the odometry, and from the delta of its step, to the transform; of these the solver's; and
    from that delta to the pose with its covariance."""

    total: float
    after_step: float
    solver: float
    pose: float = 0.0


class Robot:
    """Sends odometry and hears what comes of it."""

    def __init__(self, bus: zenoh.Session) -> None:
        import ros
        import words

        self._ros, self._words, self._bus = ros, words, bus
        self._node = ros.RosNode(bus, DOMAIN)
        self._came: queue.SimpleQueue[tuple[str, float, bytes]] = queue.SimpleQueue()
        self._poses: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
        self._where, self._ns = (0.0, 0.0, 0.0), 10**9
        self.sizes: dict[str, int] = {}
        for word, key in (("delta", keys.delta_key(MAP)), ("tf", ros.topic_key(DOMAIN, "/tf", words.TFMessage))):
            bus.declare_subscriber(key, Callback(self._hear(word), indirect=False))
        pose = ros.topic_key(DOMAIN, "/factorbus/pose", words.PoseWithCovarianceStamped)
        bus.declare_subscriber(pose, Callback(self._hear_pose, indirect=False))
        self._node.wait_for_endpoints(8)

    def exchange(self) -> Sample:
        """One keyframe on."""
        self._where, self._ns = self._ros.compose(self._where, STEP), self._ns + 10**9
        message = self._ros.odometry(self._ns, self._where, [1e-4] * 6)
        start = time.perf_counter()
        self._node.publish("/odom", message)
        came = self._wait()
        while self._stamp(came["tf"][1]) < self._ns:
            came["tf"] = self._wait_for("tf")
        self.sizes = {"odometry": len(message.serialize()), **{word: len(data) for word, (_, data) in came.items()}}
        solver = codec.decode_delta(came["delta"][1]).report["solver_ms"]
        pose = self._wait_for_pose()
        return replace(_sample(start, came["delta"][0], came["tf"][0], solver), pose=1e3 * (pose - came["delta"][0]))

    def _wait_for_pose(self) -> float:
        """When that of the last odometry came; those of further steps may come before it."""
        while True:
            at, data = self._poses.get(timeout=30)
            stamp = self._words.PoseWithCovarianceStamped.deserialize(data).header.stamp
            if stamp.sec * 10**9 + stamp.nanosec >= self._ns:
                return at

    def _wait(self) -> dict[str, tuple[float, bytes]]:
        """The delta and a transform, in whichever order."""
        came: dict[str, tuple[float, bytes]] = {}
        while len(came) < 2:
            word, at, data = self._came.get(timeout=30)
            came[word] = (at, data)
        return came

    def _wait_for(self, wanted: str) -> tuple[float, bytes]:
        while True:
            word, at, data = self._came.get(timeout=30)
            if word == wanted:
                return at, data

    def _stamp(self, data: bytes) -> int:
        stamp = self._words.TFMessage.deserialize(data).transforms[0].header.stamp
        return stamp.sec * 10**9 + stamp.nanosec

    def _hear_pose(self, sample: zenoh.Sample) -> None:
        self._poses.put((time.perf_counter(), sample.payload.to_bytes()))

    def _hear(self, word: str) -> Callable[[zenoh.Sample], None]:
        return lambda sample: self._came.put((word, time.perf_counter(), sample.payload.to_bytes()))


class BareRobot:
    """The same over the floor."""

    def __init__(self, bus: zenoh.Session, sizes: dict[str, int]) -> None:
        for _ in bus.get(f"{FLOOR}/sizes", payload=json.dumps([200, sizes["delta"]])):
            pass
        self._odometry = bytes(sizes["odometry"])
        self._came: queue.SimpleQueue[tuple[str, float]] = queue.SimpleQueue()
        for word, key in (("delta", f"{FLOOR}/out"), ("tf", f"{RELAY}/tf")):
            bus.declare_subscriber(key, Callback(self._hear(word), indirect=False))
        self._publisher = bus.declare_publisher(f"{RELAY}/odom")

    def exchange(self) -> Sample:
        """One odometry on."""
        start = time.perf_counter()
        self._publisher.put(self._odometry)
        at = dict(self._came.get(timeout=30) for _ in range(2))
        return _sample(start, at["delta"], at["tf"], 0.0)

    def _hear(self, word: str) -> Callable[[zenoh.Sample], None]:
        return lambda _: self._came.put((word, time.perf_counter()))


def _sample(start: float, delta: float, transform: float, solver: float) -> Sample:
    return Sample(1e3 * (transform - start), 1e3 * (transform - delta), solver)


def relay(endpoint: str, insert_bytes: int, transform_bytes: int) -> None:
    """A bridge that does nothing: odometry becomes a query, a delta becomes a transform."""
    stop = threading.Event()
    with session(endpoint) as bus:
        insert, transform = bytes(insert_bytes), bytes(transform_bytes)
        publisher = bus.declare_publisher(f"{RELAY}/tf", express=True)

        def on_odometry(_: zenoh.Sample) -> None:
            nothing = Callback(lambda _: None, indirect=False)
            bus.get(f"{FLOOR}/in", nothing, payload=insert, consolidation=zenoh.ConsolidationMode.NONE)

        bus.declare_subscriber(f"{FLOOR}/out", Callback(lambda _: publisher.put(transform), indirect=False))
        bus.declare_subscriber(f"{RELAY}/odom", Callback(on_odometry, indirect=False))
        token = bus.liveliness().declare_token(f"{RELAY}/live")
        gc.collect()
        gc.freeze()
        print("ready", endpoint, flush=True)
        threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
        stop.wait()
        token.undeclare()


def run(rounds: int, samples: int) -> dict[str, Any]:
    """Measure; times in milliseconds."""
    bench = str(Path(__file__).with_name("bus.py"))
    at_once = ("--connect", "{}", "--domain", str(DOMAIN), "--quiet", "--until-eof")
    with process("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0") as ours, process(bench, "--echo") as hub:
        options = [option.format(ours) for option in at_once]
        with process("-m", "factorbus.cli", "ros2", MAP, *options), session(ours) as bus:
            robot = Robot(bus)
            for _ in range(2 * BLOCK):
                robot.exchange()
            sizes = {"insert": insert_bytes(), **robot.sizes}
            words = ("--relay", hub, str(sizes["insert"]), str(sizes["tf"]))
            with process(__file__, *words), session(hub) as bare_bus:
                bare = BareRobot(bare_bus, sizes)
                for _ in range(2 * BLOCK):
                    bare.exchange()
                gc.collect()
                gc.freeze()
                ours_taken, bare_taken = _taken(robot, bare, rounds, samples)
    return _result(sizes, ours_taken, bare_taken)


def _taken(robot: Robot, bare: BareRobot, rounds: int, samples: int) -> tuple[list[Sample], list[Sample]]:
    ours: list[Sample] = []
    floor: list[Sample] = []
    for _ in range(-(-rounds * samples // BLOCK)):
        ours += [robot.exchange() for _ in range(BLOCK)]
        floor += [bare.exchange() for _ in range(BLOCK)]
    return ours, floor


def _result(sizes: dict[str, int], ours: list[Sample], floor: list[Sample]) -> dict[str, Any]:
    bus, bare = np.array([s.total - s.solver for s in ours]), np.array([s.total for s in floor])
    after, bare_after = np.array([s.after_step for s in ours]), np.array([s.after_step for s in floor])
    return {
        "samples": len(ours),
        "bytes": sizes,
        "after_step_ms": _rounded(after),
        "after_step_floor_ms": _rounded(bare_after),
        "pose_ms": _rounded(np.array([s.pose for s in ours])),
        "odometry_to_transform_ms": _rounded(np.array([s.total for s in ours])),
        "without_solver_ms": _rounded(bus),
        "floor_ms": _rounded(bare),
        "solver_ms": _rounded(np.array([s.solver for s in ours])),
        "ratio": {f"p{q}": round(float(np.percentile(bus, q) / np.percentile(bare, q)), 2) for q in (50, 90, 99)},
        "goal_ms": GOAL_MS,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
    }


def _rounded(milliseconds: np.ndarray) -> dict[str, float]:
    return {word: round(value / 1e3, 3) for word, value in percentiles(1e3 * milliseconds).items()}


def insert_bytes() -> int:
    """Of a keyframe's insert."""
    draft = Draft().se2("x2").between_se2("x1", "x2", STEP, information=np.eye(3))
    return len(codec.encode_insert(Insert(1000, draft.batch(), epoch=1 << 62)))


def table(result: dict[str, Any]) -> str:
    """The result for a person."""
    size = result["bytes"]
    lines = [
        f"an odometry that is a keyframe ({size['odometry']} B) until its transform ({size['tf']} B) is back; "
        f"{result['samples']} samples, ms",
        f"{'':38}{'p50':>9}{'p90':>9}{'p99':>9}",
    ]
    for what, row in (
        ("from the step to the transform", "after_step_ms"),
        ("the same over bare Zenoh", "after_step_floor_ms"),
        ("from the step to pose and covariance", "pose_ms"),
        ("from odometry to the transform", "odometry_to_transform_ms"),
        ("of that the solver", "solver_ms"),
        ("the rest", "without_solver_ms"),
        ("the same over bare Zenoh", "floor_ms"),
        ("ratio of the rest", "ratio"),
    ):
        lines.append(f"{what:38}" + "".join(f"{result[row][p]:9.2f}" for p in ("p50", "p90", "p99")))
    return "\n".join([*lines, f"goal: from the step, p50, at most {GOAL_MS:g} ms; load {result['load']:.1f}"])


def main() -> int:
    """Run it; 1 when the goal is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--samples", type=int, default=250)
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    parser.add_argument("--relay", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.relay:
        relay(options.relay[0], int(options.relay[1]), int(options.relay[2]))
        return 0
    result = run(options.rounds, options.samples)
    print(json.dumps(result) if options.json else table(result))
    return 0 if max(result["after_step_ms"]["p50"], result["pose_ms"]["p50"]) <= GOAL_MS else 1


if __name__ == "__main__":
    sys.exit(main())
