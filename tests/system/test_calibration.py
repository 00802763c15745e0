"""A robot with GNSS and wheels of unknown radius, over the bus: frame and scale are found, and are there again."""

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from processes import Process

from factorbus.client import Changes, Draft, Map, connect
from factorbus.client.geodetic import enu
from factorbus.proto.symbols import symbol

HEADING, SCALE, START = 2.5, 1.04, np.array([100.0, 50.0, 1.0])
ORIGIN, ANTENNA = (48.1, 11.6, 520.0), np.array([-0.3, 0.0, 1.0])
METRES = enu((48.101, 11.601, 520.0), ORIGIN)[:2] / 0.001  # of a degree to the east, and to the north
STILL, GNSS = [0.02] * 3 + [0.01] * 3, [0.3, 0.3, 0.3]


def in_space(pose: np.ndarray) -> np.ndarray:
    return np.array([pose[0], pose[1], 0, 0, 0, np.sin(pose[2] / 2), np.cos(pose[2] / 2)])


def turned(angle: float, v: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def fix(pose: np.ndarray, rng: np.random.Generator) -> tuple[float, float, float]:
    antenna = pose[:2] + turned(pose[2], ANTENNA[:2])
    east, north = START[:2] + turned(HEADING, antenna) + rng.normal(0, 0.3, 2)
    return ORIGIN[0] + north / METRES[1], ORIGIN[1] + east / METRES[0], 522 + rng.normal(0, 0.3)


def drive(robot: Map, poses: int) -> None:
    """In curves on the ground; where the map lies is known to 100 m, and which way is down."""
    rng, pose = np.random.default_rng(7), np.zeros(3)
    place = fix(pose, rng)
    rough = (*enu(place, ORIGIN), 0, 0, 0, 1)
    start = Draft().se3("x0", in_space(pose), fixed=True)
    start.vector("s0", [1.0]).linear(["s0"], [[1.0]], [[[1.0]]], [0.0], sigmas=0.1)
    start.se3("f0", rough).prior_se3("f0", rough, sigmas=(100, 100, 100, 0.02, 0.02, 3))
    robot.insert(start.gnss("x0", *place, origin=ORIGIN, frame="f0", lever=ANTENNA, sigmas=GNSS))
    for n in range(1, poses):
        turn = 0.3 * np.sin(0.3 * n)
        pose = np.array([*(pose[:2] + turned(pose[2], np.array([1.0, 0.0]))), pose[2] + turn])
        step, rolled = Draft().se3(f"x{n}"), (1 + rng.normal(0, 0.02)) / SCALE
        way = in_space(np.array([rolled, 0, turn + rng.normal(0, 0.01)]))
        step.between_se3(f"x{n - 1}", f"x{n}", way, scale="s0", sigmas=STILL)
        robot.insert(step.gnss(f"x{n}", *fix(pose, rng), origin=ORIGIN, frame="f0", lever=ANTENNA, sigmas=GNSS))


def saved_as(path: Path, endpoint: str) -> str:
    """What `factorbus save` says, which ends well."""
    command = [sys.executable, "-m", "factorbus.cli", "save", "robot", str(path), "--connect", endpoint]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stderr


def test_frame_and_scale_are_found_and_asked_about_and_there_after_a_kill(
    spawn: Callable[..., Process], tmp_path: Path
) -> None:
    serve = ("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--journal", str(tmp_path / "journal"))
    service = spawn(*serve)
    endpoint = service.ready()[0]
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("robot") as robot:
        drive(robot, 40)
        robot.settle()
        # The map is of one robot: the frame has no trajectory, and graph files say that they leave it out.
        for name in ("way.tum", "map.g2o"):
            assert ("1 frame left out" in saved_as(tmp_path / name, endpoint)) == (name == "map.g2o")
        assert len((tmp_path / "way.tum").read_text().splitlines()) == 40
        (last,) = robot.uncertainty.last().groups
        assert last.keys.tolist() == [symbol("x", 39)]
        sigma = np.sqrt(np.diag(robot.uncertainty.joint(["s0", "f0"])))
        scale, f = robot.estimate["s0"][0], robot.estimate["f0"]
        assert abs(scale - SCALE) < 4 * sigma[0] < 0.05
        assert abs(2 * np.arctan2(f[5], f[6]) - HEADING) < 4 * sigma[6] < 0.2
        assert (np.abs(f[:3] - START) < 4 * np.linalg.norm(sigma[1:4])).all()
        # A wrong fix is seen through, told of, and undone.
        false = Draft().se3("x40").between_se3("x39", "x40", (1, 0, 0, 0, 0, 0, 1), scale="s0", sigmas=STILL)
        false.position_se3("x40", (0, 0, 0), frame="f0", lever=ANTENNA, sigmas=GNSS)
        before, accepted = robot.estimate["f0"], robot.insert(false)
        robot.wait_converged()
        account = robot.uncertainty.why(factor=accepted.first_factor + 1).factor
        assert account["keys"] == [symbol("x", 40), symbol("f", 0)]
        assert account["chi2"] > 1e2
        gated = robot.uncertainty.gate(Draft().position_se3("x39", (0, 0, 0), frame="f0", sigmas=GNSS))
        assert not gated.plausible[0]
        robot.change(Changes().undo(false, accepted), settle=True)
        np.testing.assert_allclose(robot.estimate["f0"], before, atol=1e-5)
        # The oldest poses go; what they knew of frame and scale stays.
        robot.change(Changes().marginalize(*(f"x{n}" for n in range(1, 12))), settle=True)
        np.testing.assert_allclose(robot.estimate["f0"], before, atol=1e-3)
        robot.wait_converged()
        last, graph = robot.ask_estimate(), robot.graph()
    service.signal(signal.SIGKILL)
    service.wait()
    again = spawn(*serve)
    with connect(again.ready()[0], client="robot", timeout_s=60) as bus, bus.map("robot", create=False) as robot:
        now, new = robot.ask_estimate(), robot.graph()
        assert (now.epoch, now.revision) == (last.epoch, last.revision)
        for a, b in zip(last.variables, now.variables, strict=True):
            assert (a.keys.tobytes(), a.values.tobytes()) == (b.keys.tobytes(), b.values.tobytes())
        for a, b in zip(graph.batch.factors, new.batch.factors, strict=True):
            assert (a.kind, a.keys.tobytes(), a.ids.tobytes()) == (b.kind, b.keys.tobytes(), b.ids.tobytes())
