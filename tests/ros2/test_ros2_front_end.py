"""From messages to factors: how certain, of what, and what happens when something is missing."""

import math
from typing import Any

import numpy as np
import pytest
import ros
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from factorbus.client import Draft
from factorbus.proto.messages import Factors
from factorbus.proto.symbols import symbol
from factorbus.ros2.certainty import checked_covariance, floored
from factorbus.ros2.front_end import FrontEnd
from factorbus.ros2.geometry import (
    Transform,
    adjoint,
    between,
    from_plane,
    from_quaternion,
    local,
    quaternion,
    rotation_exp,
    rotation_vector,
)
from factorbus.ros2.messages import DETECTIONS, ODOMETRY, POSE, Messages
from factorbus.ros2.observations import landmark_index
from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.settings import Floors, Settings
from factorbus.ros2.space import SPACES

MESSAGES = Messages("jazzy")
SECOND = 10**9
TINY = Floors(drift_m=1e-9, drift_rad=1e-9, turn_rad=1e-9, least_m=1e-7, least_rad=1e-7, pose_m=1e-7, pose_rad=1e-7,
              landmark_m=1e-7)  # fmt: skip
seeds = st.integers(0, 2**32 - 1)


def front_end(wait: bool = False, **settings: Any) -> FrontEnd:
    return FrontEnd(Settings(**settings), 0, (), wait)


def read(type_name: str, message: Any) -> Any:
    return MESSAGES.read("/t", type_name, bytes(message.serialize()))


def say(
    made: FrontEnd, at_s: float, where: tuple[float, float, float], speeds: list[float] | None = None
) -> Draft | None:
    return made.odometry(read(ODOMETRY, ros.odometry(int(at_s * SECOND), where, speeds)))


def only(draft: Draft | None, kind: str) -> Factors:
    assert draft is not None
    (group,) = [group for group in draft.batch().factors if group.kind == kind]
    return group


def stamps_of(draft: Draft | None) -> list[int]:
    """The time stamps of the new poses."""
    assert draft is not None
    return [stamp for g in draft.batch().variables if g.stamps is not None for stamp in g.stamps.tolist()]


def covariance_of(group: Factors, dim: int) -> np.ndarray:
    information = np.zeros((dim, dim))
    information[np.triu_indices(dim)] = group.information[0]
    return np.linalg.inv(information + np.triu(information, 1).T)


def random_transform(random: np.random.Generator) -> Transform:
    turn = random.normal(size=4)
    return from_quaternion(random.normal(size=3).tolist(), (turn / np.linalg.norm(turn)).tolist())


def exp(delta: np.ndarray) -> Transform:
    """To first order in the translation, which is all that is asked of it here."""
    return Transform(rotation_exp(delta[3:]), delta[:3])


@given(seeds)
def test_transforms_are_a_group_with_its_adjoint(seed: int) -> None:
    random = np.random.default_rng(seed)
    a, b = random_transform(random), random_transform(random)
    p = random.normal(size=3)
    assert_allclose((a @ b).R @ p + (a @ b).t, a.R @ (b.R @ p + b.t) + a.t, atol=1e-12)
    assert_allclose((a @ a.inverse()).R, np.eye(3), atol=1e-12)
    assert_allclose(from_quaternion((0, 0, 0), quaternion(a.R)).R, a.R, atol=1e-12)
    assert_allclose(rotation_exp(rotation_vector(a.R)), a.R, atol=1e-9)
    assert_allclose(between(a, b, 1.0).R, b.R, atol=1e-9)
    delta = 1e-6 * random.normal(size=6)
    left, right = a @ exp(delta) @ a.inverse(), exp(adjoint(a) @ delta)
    assert_allclose(left.t, right.t, atol=1e-10)
    assert_allclose(left.R, right.R, atol=1e-10)


@given(seeds)
def test_floors_hold_in_every_direction_and_leave_alone_what_is_larger(seed: int) -> None:
    random = np.random.default_rng(seed)
    root = random.normal(size=(3, random.integers(0, 4))) * 10.0 ** random.integers(-4, 3)
    floor = 10.0 ** random.uniform(-3, 0, 3)
    made = floored(root @ root.T, floor)
    for direction in random.normal(size=(20, 3)):
        assert direction @ made @ direction >= (1 - 1e-9) * direction @ np.diag(floor**2) @ direction
        assert (
            direction @ made @ direction
            >= (1 - 1e-9) * direction @ root @ root.T @ direction - 1e-9 * np.abs(made).max()
        )
    large = root @ root.T + np.diag(floor**2)
    assert_allclose(floored(large, floor), large, rtol=1e-9, atol=1e-12 * np.abs(large).max())


@pytest.mark.parametrize("bad", [[math.nan], [math.inf], [-1.0], [1.0, 2.0]])
def test_what_cannot_be_a_covariance_is_refused(bad: list[float]) -> None:
    numbers = np.zeros(36)
    numbers[: len(bad)] = bad
    with pytest.raises(BadRosMessage):
        checked_covariance("/odom", numbers, (0, 1, 5))
    elsewhere = np.zeros(36)
    elsewhere[14] = bad[0]  # z, which does not count in the plane
    if len(bad) == 1:
        assert not checked_covariance("/odom", elsewhere, (0, 1, 5)).whole.any()


def test_the_first_odometry_begins_the_map_and_the_next_makes_keyframes() -> None:
    made = front_end()
    first = say(made, 1, (3.0, 4.0, 0.5))
    assert first is not None
    (group,) = first.batch().variables
    assert (group.kind, group.fixed, group.keys.tolist()) == ("se2", True, [symbol("x", 0)])
    assert stamps_of(first) == [SECOND]
    assert_allclose(group.values, [[3.0, 4.0, 0.5]])
    assert say(made, 2, ros.compose((3.0, 4.0, 0.5), (0.4, 0.0, 0.1))) is None  # neither far nor turned
    second = say(made, 3.000000001, ros.compose((3.0, 4.0, 0.5), (0.6, 0.1, 0.2)))
    assert stamps_of(second) == [3 * SECOND + 1]
    edge = only(second, "between_se2")
    assert edge.keys.tolist() == [[symbol("x", 0), symbol("x", 1)]]
    assert_allclose(edge.measured, [[0.6, 0.1, 0.2]], atol=1e-12)
    turned = only(say(made, 4, ros.compose((3.0, 4.0, 0.5), (0.6, 0.1, 0.6))), "between_se2")
    assert_allclose(turned.measured, [[0.0, 0.0, 0.4]], atol=1e-12)


def test_zero_covariance_counts_as_the_floor() -> None:
    made = front_end()
    say(made, 1, (0.0, 0.0, 0.0))
    edge = only(say(made, 2, (2.0, 0.0, 0.0)), "between_se2")
    assert_allclose(covariance_of(edge, 3), np.diag([0.04**2, 0.04**2, 0.02**2]), rtol=1e-9)


@pytest.mark.parametrize("space", ["plane", "space"])
def test_the_covariance_of_a_way_is_what_independent_velocities_make_of_it(space: str) -> None:
    """Against 20,000 drives along a curve, each sample's velocity off by itself."""
    speeds, step = [0.04, 0.01, 0.0, 0.0, 0.0, 0.02], (0.1, 0.0, 0.05)
    made = front_end(space=space, floors=TINY, keyframe_m=0.75, keyframe_rad=3.0)
    where, edge = (0.0, 0.0, 0.0), None
    say(made, 0, where)
    for n in range(1, 9):
        where = ros.compose(where, step)
        edge = say(made, 0.5 * n, where, speeds)
    random = np.random.default_rng(1)
    noise = random.normal(size=(20_000, 8, 3)) * np.sqrt([0.04, 0.01, 0.02]) * 0.5
    x, y, yaw = np.zeros((3, 20_000))
    for n in range(8):
        dx, dy, turn = np.array(step)[:, None] + noise[:, n].T
        x, y = x + np.cos(yaw) * step[0] - np.sin(yaw) * step[1], y + np.sin(yaw) * step[0] + np.cos(yaw) * step[1]
        yaw = yaw + step[2]
        x, y = x + np.cos(yaw) * (dx - step[0]) - np.sin(yaw) * dy, y + np.sin(yaw) * (dx - step[0]) + np.cos(yaw) * dy
        yaw = yaw + turn - step[2]
    c, s = math.cos(where[2]), math.sin(where[2])
    local_errors = [c * (x - where[0]) + s * (y - where[1]), -s * (x - where[0]) + c * (y - where[1]), yaw - where[2]]
    seen = np.cov(local_errors)
    if space == "plane":
        told = covariance_of(only(edge, "between_se2"), 3)
    else:
        halves = np.diag([1.0, 1.0, 2.0])
        told = halves @ covariance_of(only(edge, "between_se3"), 6)[np.ix_((0, 1, 5), (0, 1, 5))] @ halves
    assert_allclose(told, seen, atol=0.06 * np.abs(seen).max())


def test_where_twists_say_nothing_the_growth_of_the_pose_counts() -> None:
    made = front_end(floors=TINY)
    for n, grown in ((0, 0.0), (1, 0.01)):
        message = ros.odometry(n * SECOND, (float(n), 0.0, 0.0))
        message.pose.covariance = ros.diagonal(0.1 + grown, 0.1 + 2 * grown, 0, 0, 0, 0.0)
        draft = made.odometry(read(ODOMETRY, message))
    assert_allclose(np.diag(covariance_of(only(draft, "between_se2"), 3))[:2], [0.01, 0.02], rtol=1e-6)


def test_a_map_that_begins_with_a_pose_begins_at_the_odometry_before_it() -> None:
    made = front_end(wait=True)
    for at_s in (1, 2):
        assert say(made, at_s, (0.1 * at_s, 0.0, 0.0)) is None
    told = made.pose("/p", read(POSE, ros.known_pose(int(1.5 * SECOND), (7.0, 8.0, 0.0), [0.1] * 6)))
    assert stamps_of(told) == [SECOND]


def test_odometry_that_does_not_say_whose_it_is_is_the_robots() -> None:
    made = front_end()
    for n in range(3):
        message = ros.odometry(n * SECOND, (n * 1.0, 0.0, 0.0))
        message.child_frame_id = ""
        assert made.odometry(read(ODOMETRY, message)) is not None
    assert made.base_frame == "base_link"
    assert [text for _, text in made.remarks] == ["no child_frame_id: the robot's frame is taken to be 'base_link'"]
    named = read(ODOMETRY, ros.odometry(3 * SECOND, (3.0, 0.0, 0.0)))
    assert made.odometry(named) is not None, "one that names the same frame"
    message = ros.odometry(4 * SECOND, (4.0, 0.0, 0.0))
    message.header.frame_id = ""
    with pytest.raises(BadRosMessage, match="frames"):
        made.odometry(read(ODOMETRY, message))


def test_covariances_that_repeat_are_looked_at_once_and_refused_each_time() -> None:
    good, bad = np.eye(6).ravel(), -np.eye(6).ravel()
    assert checked_covariance("/a", good, (0, 1, 5)) is checked_covariance("/b", good.copy(), (0, 1, 5))
    for topic in ("/a", "/b"):
        with pytest.raises(BadRosMessage, match=topic):
            checked_covariance(topic, bad, (0, 1, 5))


def test_a_pose_is_carried_to_its_keyframe_with_its_covariance() -> None:
    """At x0 the robot is at the origin; half a metre on, a pose says where it is: x0 is half a metre behind that."""
    made = front_end(floors=TINY, keyframe_m=1.0)
    say(made, 0, (0.0, 0.0, 0.0))
    say(made, 1, (0.5, 0.0, 0.0))
    told = made.pose("/p", read(POSE, ros.known_pose(SECOND, (7.0, 8.0, math.pi / 2), [0.04, 0.09, 0, 0, 0, 0.01])))
    prior = only(told, "prior_se2")
    assert prior.keys.tolist() == [[symbol("x", 0)]]
    assert_allclose(prior.measured, [[7.0, 7.5, math.pi / 2]], atol=1e-9)
    # In the robot's axes 0.09 is ahead and 0.04 to the left; half a metre back, the heading moves it sideways.
    wanted = [[0.09, 0, 0], [0, 0.04 + 0.25 * 0.01, -0.5 * 0.01], [0, -0.5 * 0.01, 0.01]]
    assert_allclose(covariance_of(prior, 3), wanted, atol=1e-8)


@given(seeds)
def test_observations_have_the_covariance_of_their_derivatives(seed: int) -> None:
    """The mount, the way since the keyframe and the observation, each off by a little, one after the other."""
    random = np.random.default_rng(seed)
    mount, p = random_transform(random), random.normal(size=3) * 3
    speeds = (random.uniform(0.1, 1, 6) ** 2).tolist()
    made = FrontEnd(
        Settings(space="space", floors=TINY, keyframe_m=9.0, keyframe_rad=9.0, mounts={"cam": mount}), 0, (), False
    )
    say(made, 0, (0.0, 0.0, 0.0))
    where = (0.3, -0.2, 0.4)
    say(made, 1, where, speeds)
    seen = made.detections("/d", read(DETECTIONS, ros.detections(SECOND, "cam", [("7", tuple(p), 0.3)])))
    factor = only(seen, "landmark_se3")
    assert factor.keys.tolist() == [[symbol("x", 0), symbol("l", 7)]]
    way = from_plane(*where)

    def place(delta: np.ndarray, off: np.ndarray) -> np.ndarray:
        T = way @ exp(delta) @ mount
        return T.R @ (p + off) + T.t

    assert_allclose(factor.measured[0], place(np.zeros(6), np.zeros(3)), atol=1e-9)
    h = 1e-6
    by_way = np.column_stack([(place(h * e, np.zeros(3)) - place(-h * e, np.zeros(3))) / (2 * h) for e in np.eye(6)])
    by_observation = np.column_stack(
        [(place(np.zeros(6), h * e) - place(np.zeros(6), -h * e)) / (2 * h) for e in np.eye(3)]
    )
    wanted = by_way @ np.diag(speeds) @ by_way.T + 0.09 * by_observation @ by_observation.T
    assert_allclose(covariance_of(factor, 3), wanted, rtol=1e-4, atol=1e-5)


def test_what_comes_before_its_odometry_waits_for_it() -> None:
    made = front_end(keyframe_m=5.0)
    say(made, 0, (0.0, 0.0, 0.0))
    early = read(DETECTIONS, ros.detections(SECOND, "base_link", [("1", (1.0, 0.0, 0.0), 0.1)]))
    assert made.detections("/d", early) is None
    assert say(made, 0.5, (0.5, 0.0, 0.0)) is None
    # Between the odometry of 0.5 s and of 1.5 s, half way.
    draft = say(made, 1.5, (1.5, 0.0, 0.0))
    assert_allclose(only(draft, "landmark_se2").measured, [[2.0, 0.0]], atol=1e-9)
    assert draft is not None
    assert [group.kind for group in draft.batch().variables] == ["point2"]
    again = made.detections(
        "/d", read(DETECTIONS, ros.detections(int(1.5 * SECOND), "base_link", [("1", (0.5, 0, 0), 0.1)]))
    )
    assert again is not None
    assert not again.batch().variables


def test_after_a_refusal_it_goes_on_from_what_is_there() -> None:
    """x1 and x2 were refused: x3 hangs on x0, with the covariance of the whole way."""
    speeds = [0.01] * 6
    one, other = front_end(floors=TINY), front_end(floors=TINY, keyframe_m=2.5)
    for made in (one, other):
        for n in range(3):
            say(made, n, (float(n), 0.0, 0.0), speeds)
    one.rewind(lambda key: key == symbol("x", 0))
    edges = [only(say(made, 3, (3.0, 0.5, 0.1), speeds), "between_se2") for made in (one, other)]
    assert edges[0].keys.tolist() == [[symbol("x", 0), symbol("x", 3)]]
    assert_allclose(edges[0].measured, edges[1].measured)
    assert_allclose(edges[0].information, edges[1].information, rtol=1e-9)


def test_messages_are_used_whole_or_not_at_all() -> None:
    made = front_end()
    say(made, 1, (0.0, 0.0, 0.0))
    seen = [("1", (1.0, 0.0, 0.0), 0.1), ("", (1.0, 0.0, 0.0), 0.1)]
    with pytest.raises(BadRosMessage, match="without id"):
        made.detections("/d", read(DETECTIONS, ros.detections(SECOND, "base_link", seen)))
    draft = made.detections("/d", read(DETECTIONS, ros.detections(SECOND, "base_link", seen[:1])))
    assert draft is not None
    assert draft.batch().variables[0].keys.tolist() == [symbol("l", 1)]  # not taken for known
    with pytest.raises(BadRosMessage, match="--mount camera="):
        made.detections("/d", read(DETECTIONS, ros.detections(SECOND, "camera", seen[:1])))
    message = ros.known_pose(SECOND, (0.0, 0.0, 0.0), [0.1] * 6)
    message.header.frame_id = "odom"
    with pytest.raises(BadRosMessage, match="in 'map'"):
        made.pose("/p", read(POSE, message))
    with pytest.raises(BadRosMessage, match="still remembered"):
        made.pose("/p", read(POSE, ros.known_pose(0, (0.0, 0.0, 0.0), [0.1] * 6)))
    with pytest.raises(BadRosMessage, match="one after the last"):
        say(made, 1, (1.0, 0.0, 0.0))


def test_identities_become_keys() -> None:
    assert landmark_index("17") == 17
    assert landmark_index("dock") != landmark_index("door")
    assert 0 <= landmark_index("dock") < 1 << 56
    assert landmark_index(str(1 << 60)) < 1 << 56


def test_planar_and_spatial_rows_are_the_maps() -> None:
    T = from_plane(1.0, 2.0, 0.5)
    assert_allclose(SPACES["plane"].row(T), [1.0, 2.0, 0.5])
    assert_allclose(SPACES["space"].row(T), [1.0, 2.0, 0.0, 0.0, 0.0, math.sin(0.25), math.cos(0.25)])
    for space in SPACES.values():
        assert_allclose(space.transform(np.array(space.row(T))).R, T.R, atol=1e-12)
    assert_allclose(
        local(np.diag([1.0, 2, 3, 4, 5, 6]), from_plane(0, 0, math.pi / 2).R), np.diag([2.0, 1, 3, 5, 4, 6]), atol=1e-12
    )
