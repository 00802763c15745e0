"""A robot that does not know where its sensor is, over the bus: the mount is found, asked about, and there again."""

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from processes import Process

from factorbus.client import Changes, Draft, Map, Refused, connect
from factorbus.proto.messages import Accepted
from factorbus.proto.symbols import symbol

MOUNT = np.array([0.4, -0.3, 0.35])  # 0.5 m and 20° off
ROUGH = np.zeros(3)
STILL = (0.02, 0.02, 0.01)


def composed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]])


def seen(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    x, y, theta = composed(pose, MOUNT)
    c, s = np.cos(theta), np.sin(theta)
    dx, dy = point - (x, y)
    return np.array([c * dx + s * dy, c * dy - s * dx])


def drive(robot: Map, poses: int) -> list[tuple[Draft, Accepted]]:
    """Curves among twelve posts, which a scanner sees from where it is."""
    rng, pose, done = np.random.default_rng(7), np.zeros(3), []
    posts = rng.uniform(-8, 8, (12, 2))
    start = Draft().se2("x0", pose, fixed=True).se2("m0", ROUGH).prior_se2("m0", ROUGH, sigmas=(1, 1, 1))
    for n, post in enumerate(posts):
        start.point2(f"l{n}").landmark_se2("x0", f"l{n}", noisy(rng, seen(pose, post)), mount="m0", sigmas=(0.05, 0.05))
    done.append((start, robot.insert(start)))
    for n in range(1, poses):
        way = np.array([0.8, 0.0, 0.4 * np.sin(0.5 * n)])
        pose = composed(pose, way)
        step = Draft().se2(f"x{n}").between_se2(f"x{n - 1}", f"x{n}", way + rng.normal(0, STILL), sigmas=STILL)
        for k in rng.choice(12, 4, replace=False).tolist():
            step.landmark_se2(f"x{n}", f"l{k}", noisy(rng, seen(pose, posts[k])), mount="m0", sigmas=(0.05, 0.05))
        done.append((step, robot.insert(step)))
    return done


def noisy(rng: np.random.Generator, at: np.ndarray) -> np.ndarray:
    return at + rng.normal(0, 0.05, 2)


def saved_as(path: Path, endpoint: str) -> str:
    """What `factorbus save` says, which ends well."""
    command = [sys.executable, "-m", "factorbus.cli", "save", "robot", str(path), "--connect", endpoint]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stderr


def test_a_mount_is_found_and_asked_about_and_there_after_a_kill(spawn: Callable[..., Process], tmp_path: Path) -> None:
    serve = ("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--journal", str(tmp_path / "journal"))
    service = spawn(*serve)
    endpoint = service.ready()[0]
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("robot") as robot:
        done = drive(robot, 40)
        robot.settle()
        # The map is of one robot: what is on it has no trajectory, and graph files say that they leave it out.
        for name in ("way.tum", "map.g2o"):
            saved = saved_as(tmp_path / name, endpoint)
            assert ("1 mount left out" in saved) == (name == "map.g2o")
        assert len((tmp_path / "way.tum").read_text().splitlines()) == 40
        late = Draft().se2("m1", ROUGH).prior_se2("m1", ROUGH, sigmas=(1, 1, 1))
        done.append((late, robot.insert(late.landmark_se2("x39", "l0", (1, 1), mount="m1", sigmas=(9, 9)))))
        robot.settle()
        (last,) = robot.uncertainty.last().groups
        assert last.keys.tolist() == [symbol("x", 39)], "the newest pose, and not the mount that came after it"
        sigma = np.sqrt(np.diag(robot.uncertainty.joint("m0")))
        off = robot.estimate["m0"] - MOUNT
        assert (np.abs(off) < 3 * sigma).all()
        assert (sigma < 0.05).all()
        # An insert is undone, with a factor of three variables in it.
        wrong = Draft().se2("x40").between_se2("x39", "x40", (1, 0, 0), sigmas=STILL)
        wrong.landmark_se2("x40", "l0", (50, 50), mount="m0", sigmas=(0.05, 0.05))
        before = robot.estimate["m0"]
        accepted = robot.insert(wrong)
        robot.wait_converged()
        account = robot.uncertainty.why(factor=accepted.first_factor + 1).factor
        assert account["keys"] == [symbol("x", 40), symbol("l", 0), symbol("m", 0)]
        assert account["chi2"] > 1e4
        gated = robot.uncertainty.gate(Draft().landmark_se2("x39", "l0", (50, 50), mount="m0", sigmas=(0.1, 0.1)))
        assert not gated.plausible[0]
        robot.change(Changes().undo(wrong, accepted), settle=True)
        np.testing.assert_allclose(robot.estimate["m0"], before, atol=1e-7)
        # The oldest poses go; what they knew of the mount stays.
        robot.change(Changes().marginalize(*(f"x{n}" for n in range(1, 12))), settle=True)
        np.testing.assert_allclose(robot.estimate["m0"], before, atol=1e-5)
        with pytest.raises(Refused) as refused:
            robot.insert(Draft().landmark_se2("x30", "l0", (1, 1), mount="l1", sigmas=(1, 1)))
        assert refused.value.code == "kind_mismatch"
        assert "l1" in str(refused.value)
        robot.wait_converged()
        last, graph = robot.ask_estimate(), robot.graph()
    assert len(done) == 41
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
