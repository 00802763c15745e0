"""Rotations, similarities, lenses, IMUs and own kinds in a journal: after a kill all of it is as it was, to the bit."""

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from journalled import Services, rows
from naive.random_cameras import CAMERAS
from processes import PATIENCE_S

from factorbus.client import Changes, Draft, ImuNoise, connect, preintegrate_samples
from factorbus.client.expressions import SE3, Vector, factor, norm
from factorbus.client.map import Map
from factorbus.journal.bundle import export_map, import_map
from factorbus.proto.symbols import symbol

STILL, NO_TURN = (0, 0, 0, 0, 0, 0, 1), (0, 0, 0, 1)
NOISE = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4)
SAMPLES = np.tile([0.01, 0.01, -0.02, 0.03, 0.1, 0.2, 9.8], (50, 1))
CAMERA = CAMERAS["radtan"]
_F, _, _, _, _K1, _K2, *_ = CAMERA.numbers
LENS = {"focal": (_F,), "bundler": (_F, _K1, _K2), "intrinsics": CAMERA.numbers}


@factor
def slack(a: SE3, b: SE3, rope: Vector[1], z: Vector[1]):
    return norm(b.position - a.position) - rope[0] - z


def first() -> Draft:
    """A pose, and what is to be found out: rotations, similarities, a mount, gravity, lenses and a rope."""
    draft = Draft().se3("x0", STILL).prior_se3("x0", STILL, sigmas=[0.01] * 6)
    draft.so3("r0", NO_TURN, fixed=True).sim3("s0", (*STILL, 1), fixed=True)
    draft.se3("m0", STILL).prior_se3("m0", (0.1, 0, 0, 0, 0, 0, 1), sigmas=[0.1] * 6)
    draft.vector("g0", (0.1, 0, -9.8)).factor("length_vector3", ("g0",), [9.80665], sigmas=0.005)
    draft.linear(["g0"], [(0, 0, -9.8)], [np.eye(3)], np.zeros(3), sigmas=[0.5] * 3)
    draft.vector("w0", [1.0]).linear(["w0"], [[1.0]], [np.eye(1)], [0.0], sigmas=[0.1])
    draft.vector("v0", np.zeros(3)).linear(["v0"], [np.zeros(3)], [np.eye(3)], np.zeros(3), sigmas=[0.1] * 3)
    draft.vector("b0", np.zeros(6)).linear(["b0"], [np.zeros(6)], [np.eye(6)], np.zeros(6), sigmas=[0.1] * 6)
    for number, numbers in enumerate(LENS.values()):
        size = len(numbers)
        draft.vector(f"c{number}", numbers)
        draft.linear([f"c{number}"], [numbers], [np.eye(size)], np.zeros(size), sigmas=[0.1] * size)
    return draft


def step(n: int, chance: np.random.Generator) -> Draft:
    """A moment more, with something of every kind."""
    at = {what: (f"{what}{n - 1}", f"{what}{n}") for what in "xvbrs"}
    draft = Draft().se3(at["x"][1]).vector(at["v"][1], size=3).vector(at["b"][1], size=6)
    before, here = ((at["x"][k], at["v"][k], at["b"][k]) for k in (0, 1))
    samples = SAMPLES + np.append(0, chance.normal(0, 0.02, 6))
    if n % 2:
        draft.imu(before, here, samples, noise=NOISE, gravity="g0", mount="m0")
    else:
        draft.imu_preintegrated(before, here, preintegrate_samples(samples, NOISE), gravity="g0")
    draft.position_se3(at["x"][1], chance.normal(0, 0.1, 3), sigmas=[0.1] * 3)
    turn, way = np.append(chance.normal(0, 0.1, 3), 1.0), np.append(chance.normal(0, 0.1, 6), 1.0)
    draft.so3(at["r"][1]).between_so3(*at["r"], turn / np.linalg.norm(turn), sigmas=[0.1] * 3)
    draft.attitude_so3(at["r"][1], chance.normal((0, 0, 1), 0.1), sigmas=[0.1] * 3)
    way[3:] /= np.linalg.norm(way[3:])
    draft.sim3(at["s"][1]).between_sim3(*at["s"], [*way, np.exp(chance.normal(0, 0.1))], sigmas=[0.1] * 7)
    draft.position_sim3(at["s"][1], chance.normal(0, 1, 3), sigmas=[1] * 3)
    draft.factor(slack, (*at["x"], "w0"), [0.1], sigmas=[0.3], loss=("huber", 1.0))
    point = chance.normal((0, 0, 6), 0.5)
    draft.point3(f"l{n}", point).prior_point3(f"l{n}", point, sigmas=[0.5] * 3)
    draft.landmark_sim3(at["s"][1], f"l{n}", chance.normal((0, 0, 6), 0.5), sigmas=[0.5] * 3)
    seen: Any = draft.point_seen
    for number, name in enumerate(LENS):
        pixel = chance.normal((320, 240), 20, 2)
        seen("x0", f"l{n}", CAMERA, pixel, sigmas=[9, 9], **{name: f"c{number}"})
    return draft


def told(driven: Map) -> tuple[Any, ...]:
    """Estimate, factors and what is asked of them: all that a restart may not change."""
    graph, estimate = driven.graph().batch, driven.ask_estimate()
    factors = [
        (group.kind, group.loss, group.keys.tobytes(), group.measured.tobytes(), group.information.tobytes())
        for group in graph.factors
    ]
    asked = [driven.uncertainty.joint(key).tobytes() for key in ("x3", "v3", "b3", "r3", "s3", "c0", "c1", "c2", "m0")]
    return rows(estimate.variables), factors, asked, driven.chi2().chi2


def drive(driven: Map) -> None:
    """Inserts, and changes of them: undone, removed, counted differently, held, marginalized."""
    chance = np.random.default_rng(5)
    driven.insert(first())
    for n in range(1, 9):
        driven.insert(step(n, chance))
    late = Draft().so3("r99", NO_TURN).prior_so3("r99", NO_TURN, sigmas=[0.1] * 3)
    late.sim3("s99", (*STILL, 2)).prior_sim3("s99", (*STILL, 2), sigmas=[0.1] * 7)
    driven.change(Changes().undo(late, driven.insert(late)))
    groups = driven.graph().batch.factors
    of_kind = {group.kind: group.ids.tolist() for group in groups if group.ids is not None}
    driven.change(Changes().loss(of_kind["between_so3"][4], "cauchy", 1.0).weigh(of_kind["between_sim3"][4], 0.5))
    driven.change(Changes().marginalize("s8", "r8", "v1"))
    driven.change(Changes().fix("c0", "w0"))
    driven.change(Changes().free("c0"), settle=True)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l"])
def test_every_kind_of_variable_is_there_to_the_bit_after_a_kill(
    services: Callable[..., Services], tmp_path: Path, mode: str
) -> None:
    journal = tmp_path / "journal"
    running = services(journal, "checkpoint_s=0.2")
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("kinds", mode) as driven:
        drive(driven)
        before = told(driven)
        kinds = {group.kind for group in driven.graph().batch.variables}
        assert kinds >= {"se3", "so3", "sim3", "point3", "vector1", "vector3", "vector6", "vector9"}
        assert symbol("r", 99) not in before[0]
    for _ in range(2):  # from its records, and once more from whatever it wrote of them
        running.end(signal.SIGKILL)
        with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("kinds", mode) as driven:
            assert told(driven) == before
    running.end(signal.SIGTERM)
    export_map(journal / "kinds", tmp_path / "kinds.fbmap")
    import_map(tmp_path / "kinds.fbmap", journal / "other")
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("other", mode) as driven:
        assert told(driven) == before
        again = Draft().so3("r9").between_so3("r7", "r9", NO_TURN, sigmas=[0.1] * 3)
        assert driven.insert(again).report["chi2"] >= 0
