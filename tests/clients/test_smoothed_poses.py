"""A loop is closed over a real bus: the pose that a client is given goes there without a jump, beside the raw one."""

import asyncio
import math
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from processes import processes

from factorbus.client import Draft, Map, Problem, Unavailable, aio, connect
from factorbus.client.geodesic import length_of_way
from factorbus.client.key_numbers import key_number
from factorbus.client.smoothed_poses import SmoothedPoses
from factorbus.proto.messages import Delta
from factorbus.proto.problems import NotHeld
from factorbus.proto.symbols import symbol

pytestmark = pytest.mark.timeout(300)  # the first service on a machine compiles its kernels

SIGMAS = {3: (0.1, 0.1, 0.02), 7: (0.1, 0.1, 0.1, 0.02, 0.02, 0.02)}
POSES = 21


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with processes(tmp_path_factory.mktemp("service")) as start:
        yield start("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0").ready()[0]


@pytest.fixture
def joined(endpoint: str) -> Iterator[Map]:
    with connect(endpoint, client="robot1", timeout_s=60) as bus:
        bus.drop("loop", missing_ok=True)
        with bus.map("loop") as made:
            yield made


class Clock:
    """Seconds as the test sets them."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def way(size: int, x: float, yaw: float) -> tuple[float, ...]:
    return (x, 0.0, yaw) if size == 3 else (x, 0.0, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))


def drive(joined: Map, size: int) -> None:
    """A circle, by odometry that does not quite close."""
    draft = Draft()
    kind = "se2" if size == 3 else "se3"
    getattr(draft, kind)("x0", way(size, 0.0, 0.0), fixed=True)
    for i in range(1, POSES):
        getattr(draft, kind)(f"x{i}")
        getattr(draft, f"between_{kind}")(f"x{i - 1}", f"x{i}", way(size, 1.0, 0.25), sigmas=SIGMAS[size])
    joined.insert(draft)


def close_loop(joined: Map, size: int) -> None:
    draft = Draft()
    kind = "se2" if size == 3 else "se3"
    getattr(draft, f"between_{kind}")("x0", f"x{POSES - 1}", way(size, 0.0, 0.0), sigmas=SIGMAS[size])
    joined.insert(draft, settle=True)
    joined.wait_converged()


@pytest.mark.parametrize("size", [3, 7])
def test_a_closed_loop_arrives_little_by_little(joined: Map, size: int) -> None:
    last, clock = f"x{POSES - 1}", Clock()
    poses = SmoothedPoses(joined.estimate, clock)
    drive(joined, size)
    old = joined.estimate[last]
    assert_array_equal(poses.pose(last, 2.0).pose, old)
    close_loop(joined, size)
    new = joined.estimate[last]
    whole = length_of_way(old, new)
    assert whole > 0.5, "else there is nothing to blend"
    given = [poses.pose(last, 2.0)]
    assert_array_equal(given[0].pose, old)
    assert given[0].left_s == pytest.approx(2.0)
    for _ in range(20):
        clock.now_s += 0.1
        given.append(poses.pose(last, 2.0))
    assert_array_equal([each.raw for each in given], [new] * 21)
    steps = [length_of_way(a.pose, b.pose) for a, b in pairwise(given)]
    np.testing.assert_allclose(steps, whole / 20, rtol=1e-6)
    clock.now_s += 0.1
    assert_array_equal(poses.pose(last, 2.0).pose, new)
    assert poses.pose(last, 2.0).left_s == 0.0


def test_how_often_one_asks_does_not_change_what_is_given(joined: Map) -> None:
    """A correction counts from when it came, also for those who ask much later."""
    last, clock = f"x{POSES - 1}", Clock()
    poses = SmoothedPoses(joined.estimate, clock)
    drive(joined, 3)
    old = poses.pose(last, 2.0).raw
    poses.pose(last, 20.0)
    close_loop(joined, 3)
    clock.now_s += 5.0
    new = joined.estimate[last]
    assert_array_equal(poses.pose(last, 2.0).pose, new)
    slow = poses.pose(last, 20.0)
    assert slow.left_s == pytest.approx(15.0)
    assert length_of_way(slow.pose, new) == pytest.approx(0.75 * length_of_way(old, new), rel=1e-6)
    # One that is asked for the first time is as it is.
    assert_array_equal(poses.pose("x5", 2.0).pose, joined.estimate["x5"])


def test_a_map_gives_it_by_the_clock_of_the_machine(joined: Map) -> None:
    last, smooth_s = f"x{POSES - 1}", 0.5
    drive(joined, 3)
    old = joined.pose(last, smooth_s=smooth_s).pose
    assert_array_equal(joined.pose(last).pose, joined.estimate[last])
    given, asked_s, answered_s = [old], [time.monotonic()], [time.monotonic()]
    close_loop(joined, 3)
    while time.monotonic() < asked_s[0] + 60.0:
        asked_s.append(time.monotonic())
        now = joined.pose(last, smooth_s=smooth_s)
        answered_s.append(time.monotonic())
        given.append(now.pose)
        if now.left_s == 0.0:
            break
    assert_array_equal(given[-1], joined.estimate[last])
    raw = joined.pose(last)
    assert_array_equal(raw.pose, raw.raw)
    speed = 2.0 * length_of_way(old, given[-1]) / smooth_s
    for (a, b), asked, answered in zip(pairwise(given), asked_s, answered_s[1:], strict=False):
        assert length_of_way(a, b) <= speed * (answered - asked) + 1e-9


def test_a_map_made_anew_is_no_correction(endpoint: str, joined: Map) -> None:
    drive(joined, 3)
    joined.pose("x1", smooth_s=1e6)
    with connect(endpoint, client="operator", timeout_s=60) as bus:
        bus.drop("loop")
        with bus.map("loop") as other:
            other.insert(Draft().se2("x1", (7.0, 7.0, 0.0), fixed=True))
            joined.rejoin()
            while joined.estimate.epoch != other.epoch or "x1" not in joined.estimate:
                joined.estimate.wait_for(joined.estimate.revision + 1)
            assert_array_equal(joined.pose("x1", smooth_s=1e6).pose, [7.0, 7.0, 0.0])


class HeldMirror:
    """What the poses want of a mirror, without a bus."""

    def __init__(self) -> None:
        self.epoch, self.values = 1, {symbol("x", 1): np.zeros(3)}
        self.tell: Any = None

    def on_delta(self, callback: Any) -> None:
        self.tell = callback

    def find(self, key: str | int) -> tuple[str, np.ndarray]:
        number = key_number(key)
        if number not in self.values:
            raise NotHeld("it is not here")
        return "se2", self.values[number]

    def whole(self, values: dict[int, np.ndarray], epoch: int = 1) -> None:
        self.epoch, self.values = epoch, values
        self.tell(Delta(epoch, 1, 0, ()))


@pytest.mark.parametrize("told", [True, False])
def test_a_value_of_another_epoch_is_no_correction(told: bool) -> None:
    """Also where one asks after the map has come and before its delta is passed on."""
    mirror = HeldMirror()
    poses = SmoothedPoses(mirror, Clock())  # type: ignore[arg-type]
    poses.pose("x1", 1.0)
    there = {symbol("x", 1): np.array([7.0, 7.0, 0.0])}
    if told:
        mirror.whole(there, epoch=2)
    else:
        mirror.epoch, mirror.values = 2, there
    given = poses.pose("x1", 1.0)
    assert given.left_s == 0.0
    assert_array_equal(given.pose, [7.0, 7.0, 0.0])


def test_a_pose_that_went_and_came_again_is_another() -> None:
    mirror = HeldMirror()
    poses = SmoothedPoses(mirror, Clock())  # type: ignore[arg-type]
    first = mirror.values
    poses.pose("x1", 1.0)
    mirror.whole({})
    mirror.whole({each: value + 1.0 for each, value in first.items()})
    assert_array_equal(poses.pose("x1", 1.0).pose, [1.0, 1.0, 1.0])


def test_of_many_poses_the_last_ones_asked_for_are_followed() -> None:
    mirror = HeldMirror()
    poses = SmoothedPoses(mirror, Clock())  # type: ignore[arg-type]
    mirror.values = {symbol("x", n): np.zeros(3) for n in range(1025)}
    for n in range(1025):
        poses.pose(symbol("x", n), 1.0)
    mirror.whole({each: np.ones(3) for each in mirror.values})
    assert_array_equal(poses.pose("x1024", 1.0).pose, np.zeros(3))
    assert_array_equal(poses.pose("x0", 1.0).pose, np.ones(3))


@pytest.mark.parametrize("smooth_s", [-1.0, math.nan, math.inf, "1", None, True, [1.0], 10**400])
def test_a_time_that_is_none_is_refused(joined: Map, smooth_s: object) -> None:
    joined.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
    with pytest.raises(Problem, match="smooth_s") as refused:
        joined.pose("x0", smooth_s=smooth_s)  # type: ignore[arg-type]
    assert refused.value.code == "bad_option"


def test_what_is_not_there_or_is_no_pose_is_refused(endpoint: str, joined: Map) -> None:
    joined.insert(
        Draft().se2("x0", (0, 0, 0), fixed=True).point2("l0", (1, 1)).landmark_se2("x0", "l0", (1, 1), sigmas=(1, 1))
    )
    for key in ("x99", "no key"):
        with pytest.raises(KeyError) as missing:
            joined.pose(key, smooth_s=1.0)
        assert getattr(missing.value, "code", "") == "unknown_variable"
    with pytest.raises(Problem, match="l0 of kind point2") as no_pose:
        joined.pose("l0")
    assert no_pose.value.code == "bad_option"
    with connect(endpoint, client="blind", timeout_s=60) as bus, bus.map("loop", mirror=False) as blind:
        with pytest.raises(Unavailable) as no_mirror:
            blind.pose("x0")
        assert no_mirror.value.code == "unavailable"


def test_asyncio_has_it_too(endpoint: str, joined: Map) -> None:
    joined.insert(Draft().se2("x0", (1, 2, 0.5), fixed=True))

    async def ask() -> None:
        async with aio.connect(endpoint, client="robot2", timeout_s=60) as bus, bus.map("loop") as looked:
            pose, raw, left_s = looked.pose("x0", smooth_s=1.0)
            assert_array_equal(pose, [1, 2, 0.5])
            assert_array_equal(raw, pose)
            assert left_s == 0.0

    asyncio.run(ask())
