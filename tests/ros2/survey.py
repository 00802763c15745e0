"""Two laps of a square as a robot with a front end and GNSS says them: odometry that drifts, a pose graph with loop
closures, fixes of an antenna off its middle; and the same graph as a draft, by nothing of the bridge's.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import recordings
import ros
import words
from recordings import START_NS, Said
from zenoh_ros_type.common_interfaces.geometry_msgs import Transform

from factorbus.client import Draft
from factorbus.client.geodetic import enu, geodetic
from factorbus.ros2.messages import FIX, LINK, MAP_GRAPH, ODOMETRY, POSE_GRAPH, TRANSFORMS

Pose = tuple[float, float, float]
SIDE_M, STEPS, LAPS = 10.0, 10, 2
SCALE, CURVATURE = 1.02, 0.01  # of odometry: too long, and to the left
LEVER, ORIGIN, TURN = (0.4, 0.1), (48.1, 11.5, 500.0), 0.7
SIGMA_FIX = 0.3
SPEEDS = [4e-4, 4e-4, 0.0, 0.0, 0.0, 4e-4]
CLOSURE = [0.01, 0.01, 0.01, 1e-3, 1e-3, 1e-3]  # variances
EVERY = 5  # poses of the second lap with a closure
COUNT = 1 + LAPS * 4 * (STEPS + 1)


class Survey(NamedTuple):
    """Where the robot truly was, where odometry has that, fixes, and closures (earlier, later, measured)."""

    true: list[Pose]
    told: list[Pose]
    fixes: list[tuple[float, float, float]]
    closures: list[tuple[int, int, Pose]]


def survey(seed: int = 3) -> Survey:
    random = np.random.default_rng(seed)
    true: list[Pose] = [(0.0, 0.0, 0.0)]
    told: list[Pose] = [(0.0, 0.0, 0.0)]
    for _ in range(4 * LAPS):
        for step in [(SIDE_M / STEPS, 0.0, 0.0)] * STEPS + [(0.0, 0.0, math.pi / 2)]:
            true.append(ros.compose(true[-1], step))
            told.append(ros.compose(told[-1], (SCALE * step[0], 0.0, step[2] + CURVATURE * step[0])))
    fixes = [_fix(each, random.normal(size=3) * SIGMA_FIX) for each in true]
    lap = 4 * (STEPS + 1)
    closures = [(n - lap, n, _closure(true[n - lap], true[n], random)) for n in range(lap, COUNT, EVERY)]
    return Survey(true, told, fixes, closures)


def _closure(first: Pose, second: Pose, random: np.random.Generator) -> Pose:
    x, y, yaw = ros.compose(ros.inverse(first), second)
    dx, dy, turn = random.normal(size=3) * np.sqrt([CLOSURE[0], CLOSURE[1], CLOSURE[5]])
    return x + dx, y + dy, yaw + turn


def _fix(where: Pose, noise: np.ndarray) -> tuple[float, float, float]:
    x, y, _ = ros.compose(where, (*LEVER, 0.0))
    east, north, _ = ros.compose((3.0, -4.0, TURN), (x, y, 0.0))
    latitude, longitude, altitude = geodetic(np.array([east, north, 1.0]) + noise, ORIGIN).tolist()
    return latitude, longitude, altitude


def at(n: int) -> int:
    return START_NS + n * 10**9


def said(made: Survey, graph: str = POSE_GRAPH, fixes: bool = True) -> list[Said]:
    """In the order of time; graph: the type that closures come in, "" for none."""
    there = Transform(words.Vector3(*LEVER, 1.2), words.Quaternion(0.0, 0.0, 0.0, 1.0))
    static = words.TFMessage([words.TransformStamped(words.Header(ros.stamp(at(0)), "base_link"), "gps", there)])
    messages = [Said("/tf_static", TRANSFORMS, at(0), static)]
    for n in range(COUNT):
        messages.append(Said("/odom", ODOMETRY, at(n), ros.odometry(at(n), made.told[n], SPEEDS)))
        if fixes:
            messages.append(Said("/gps/fix", FIX, at(n), ros.nav_fix(at(n), made.fixes[n], (SIGMA_FIX,) * 3)))
        messages += _graph(made, n, graph)
    return messages


def _graph(made: Survey, n: int, graph: str) -> Iterator[Said]:
    """Kimera sends what is new, RTAB-Map all that there is; its numbers begin at 1, and its links point back."""
    odometry = [(k - 1, k, 0, ros.compose(ros.inverse(made.told[k - 1]), made.told[k])) for k in range(1, n + 1)]
    closed = [(a, b, 1, where) for a, b, where in made.closures if b <= n]
    if graph == POSE_GRAPH:
        edges = [edge for edge in odometry + closed if edge[1] == n]
        yield Said("/kimera/pose_graph", POSE_GRAPH, at(n), ros.pose_graph(at(n), {n: at(n)}, edges, CLOSURE))
    elif graph == MAP_GRAPH:
        links = [ros.link(a + 1, b + 1, kind, where, CLOSURE) for a, b, kind, where in odometry + closed]
        yield Said("/mapGraph", MAP_GRAPH, at(n), ros.map_graph(at(n), list(range(1, n + 2)), links))
    elif graph == LINK:
        yield Said("/mapGraph", MAP_GRAPH, at(n), ros.map_graph(at(n), list(range(1, n + 2)), []))
        for a, b, _, where in (edge for edge in closed if edge[1] == n):
            yield Said("/link", LINK, at(n), ros.link(a + 1, b + 1, 1, where, CLOSURE))


def drafted(made: Survey, closures: bool = True, fixes: bool = True) -> Draft:
    """The graph that has to come of it."""
    draft = Draft().se2("x0", made.told[0], fixed=True)
    for n in range(1, COUNT):
        x, y, yaw = measured = ros.compose(ros.inverse(made.told[n - 1]), made.told[n])
        metres = math.hypot(x, y)
        speed = math.sqrt(SPEEDS[0])
        floors = max(speed, 0.02 * metres), max(speed, 0.02 * metres), max(speed, 0.01 * metres + 0.02 * abs(yaw))
        draft.se2(f"x{n}").between_se2(f"x{n - 1}", f"x{n}", measured, sigmas=floors)
    for a, b, where in made.closures if closures else ():
        draft.between_se2(f"x{a}", f"x{b}", where, sigmas=np.sqrt([CLOSURE[0], CLOSURE[1], CLOSURE[5]]))
    if fixes:
        draft.se2("f0", (0.0, 0.0, TURN))
        for n, fix in enumerate(made.fixes):
            place = enu(fix, made.fixes[0])[:2]
            draft.position_se2(f"x{n}", place, lever=LEVER, frame="f0", sigmas=[SIGMA_FIX] * 2)
    return draft


write = recordings.write_mcap
