"""Parts of a map of which poses were marginalized: what holds each, and which is in a frame of its own."""

from itertools import pairwise

import numpy as np
import pytest
from two_parts import drafted, drives, fill

from factorbus.client import Changes, Draft, ImuNoise, Map, attach, connect

POSES = {"se2": (0, 0, 0), "se3": (0, 0, 0, 0, 0, 0, 1)}
STEPS = {"se2": (1, 0.1, 0.3), "se3": (1, 0.1, 0.2, 0, 0, np.sin(0.15), np.cos(0.15))}
SIGMAS = {"se2": (0.1, 0.1, 0.05), "se3": (0.1,) * 3 + (0.05,) * 3}


def chain(kind: str, letter: str, poses: int = 5, fixed: bool = True) -> Draft:
    draft = Draft().variable(kind, f"{letter}0", POSES[kind], fixed=fixed)
    if not fixed:
        draft.factor(f"prior_{kind}", [f"{letter}0"], POSES[kind], sigmas=SIGMAS[kind])
    for n in range(1, poses):
        draft.variable(kind, f"{letter}{n}")
        draft.factor(f"between_{kind}", [f"{letter}{n - 1}", f"{letter}{n}"], STEPS[kind], sigmas=SIGMAS[kind])
    return draft


def told(of: Map) -> list[tuple[int, dict[str, int], bool]]:
    """Variables, what holds it, whether it is in a frame of its own: of each component."""
    return [(each.variables, dict(each.held), each.own_frame) for each in of.components().listed]


@pytest.mark.parametrize("kind", POSES)
def test_what_hung_on_a_fixed_pose_still_hangs_on_it(endpoint: str, kind: str) -> None:
    with connect(endpoint, timeout_s=60) as bus, bus.map(f"one-{kind}") as one:
        one.insert(chain(kind, "x"), settle=True)
        before, sure = one.estimate["x4"], one.uncertainty.joint(["x2", "x4"])
        one.change(Changes().marginalize("x1"))
        assert told(one) == [(4, {"fixed": 1}, True)], "all of it is one component, held by x0 alone"
        np.testing.assert_allclose(one.estimate["x4"], before, atol=1e-9)
        np.testing.assert_allclose(one.uncertainty.joint(["x2", "x4"]), sure, rtol=1e-6, atol=1e-12)
        one.change(Changes().marginalize("x2", "x3"))
        assert told(one) == [(2, {"fixed": 1}, True)]
        one.change(Changes().marginalize("x0"))
        ((variables, held, own),) = told(one)
        assert (variables, own, list(held.values())) == (1, False, [1])
        assert next(iter(held)).startswith("linear_"), "of x0 nothing is left but what it said of x4"
        last = sure[len(SIGMAS[kind]) :, len(SIGMAS[kind]) :]
        np.testing.assert_allclose(one.uncertainty.joint(["x4"]), last, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("gone", [["x0"], ["x1"], ["x0", "x1", "x2"]], ids=" ".join)
@pytest.mark.parametrize("kind", POSES)
def test_beside_a_prior_all_is_one_component(endpoint: str, kind: str, gone: list[str]) -> None:
    with connect(endpoint, timeout_s=60) as bus, bus.map(f"prior-{kind}-{len(gone)}{gone[0]}") as one:
        one.insert(chain(kind, "x", fixed=False), settle=True)
        one.change(Changes().marginalize(*gone))
        ((variables, held, own),) = told(one)
        (name,) = held
        assert (variables, held[name]) == (5 - len(gone), 1)
        if "x0" in gone:
            assert (name.startswith("linear_"), own) == (True, False), "it says where they are in the map's frame"
        else:
            assert (name, own) == (f"prior_{kind}", True), "between x0 and x2 it is relative"


def test_two_robots_stay_in_frames_of_their_own_and_can_be_attached(endpoint: str) -> None:
    """Each lost the pose behind its fixed one; the factor that was left goes along with the part that is attached."""
    one, other, candidates = drives("se2", 5, 10, 0)
    with connect(endpoint, timeout_s=60) as bus, bus.map("two-robots") as hall:
        fill(hall, one)
        fill(hall, other, "y")
        hall.insert(Draft(), settle=True)
        candidates = [each for each in candidates if 1 not in (each.a, each.b)]
        hall.change(Changes().marginalize("x1", "y1"))
        assert [(held, own) for _, held, own in told(hall)] == [({"fixed": 1}, True)] * 2
        done = attach(hall, "y", drafted("se2", candidates), settle=True)
        assert done.accepted is not None
        assert done.left_out == {"fixed": 1}, "no linear factor was in the way"
        ((_, held, _),) = told(hall)
        assert held == {"fixed": 1}


def test_gnss_that_went_into_a_linear_factor_still_holds_its_part(endpoint: str) -> None:
    with connect(endpoint, timeout_s=60) as bus, bus.map("gnss") as two:
        two.insert(chain("se2", "a"))
        two.insert(chain("se2", "b").position_se2("b2", (2, 0.5), sigmas=(1, 1)), settle=True)
        two.change(Changes().marginalize("b2"))
        rows = told(two)
        assert rows[0] == (5, {"fixed": 1}, True)
        assert rows[1][2] is False
        assert set(rows[1][1].values()) == {1}
        assert any(name.startswith("linear_") for name in rows[1][1])


def test_which_way_is_up_is_no_place(endpoint: str) -> None:
    """A pose between two inertial factors goes: what is left knows the vertical, as they did, and no place."""
    samples = np.tile([0.1, 0.0, 0.0, 0.2, 0.3, 0.1, 9.81], (10, 1))
    noise = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4)
    with connect(endpoint, timeout_s=60) as bus, bus.map("imus") as two:
        for letter, velocity, bias in ("auw", "bvz"):
            draft = Draft().se3(f"{letter}0", POSES["se3"], fixed=True)
            draft.variable("vector3", f"{velocity}0", (0, 0, 0)).variable("vector6", f"{bias}0", [0.0] * 6)
            draft.linear([f"{velocity}0"], [[0.0] * 3], [np.eye(3)], [0.0] * 3, sigmas=[0.1] * 3)
            draft.linear([f"{bias}0"], [[0.0] * 6], [np.eye(6)], [0.0] * 6, sigmas=[0.01] * 6)
            for n in range(1, 5):
                draft.se3(f"{letter}{n}").variable("vector3", f"{velocity}{n}").variable("vector6", f"{bias}{n}")
            for n, m in pairwise(range(5)):
                first, second = ((f"{letter}{k}", f"{velocity}{k}", f"{bias}{k}") for k in (n, m))
                draft.imu(first, second, samples, noise=noise)
            two.insert(draft, settle=True)
        assert [(held, own) for _, held, own in told(two)] == [({"fixed": 1}, True)] * 2
        two.change(Changes().marginalize("b2", "v2", "z2"))
        assert [(held, own) for _, held, own in told(two)] == [({"fixed": 1}, True)] * 2


def test_beside_fixed_landmarks_and_many_fixed_poses(endpoint: str) -> None:
    """More fixed poses than a linear factor has room for are left out of it; what they say is kept."""
    with connect(endpoint, timeout_s=60) as bus, bus.map("stations") as map_:
        draft = Draft().se2("x0", (0, 0, 0)).se2("x1")
        draft.between_se2("x0", "x1", STEPS["se2"], sigmas=SIGMAS["se2"])
        for n in range(130):
            draft.se2(f"s{n}", (n, 1, 0), fixed=True)
            draft.between_se2(f"s{n}", "x0", (-n, -1, 0), sigmas=SIGMAS["se2"])
        draft.point2("l0", (5, 5), fixed=True).landmark_se2("x0", "l0", (5, 5), sigmas=(0.1, 0.1))
        map_.insert(draft, settle=True)
        sure = map_.uncertainty.joint(["x1"])
        map_.change(Changes().marginalize("x0"))
        np.testing.assert_allclose(map_.uncertainty.joint(["x1"]), sure, rtol=1e-6)
        assert [held for _, held, _ in told(map_) if "fixed" not in held] == [{"linear_3_se2": 1}]


def test_what_a_fixed_pose_is_known_by_is_a_constant_that_does_not_grow(endpoint: str) -> None:
    """GNSS at poses that go says that a fixed pose is elsewhere: no step can change that, and χ² leaves it out."""
    with connect(endpoint, timeout_s=60) as bus, bus.map("window") as window:
        window.insert(chain("se2", "x", 3))
        for n in range(3, 40):
            step = Draft().se2(f"x{n}").between_se2(f"x{n - 1}", f"x{n}", STEPS["se2"], sigmas=SIGMAS["se2"])
            window.insert(step.position_se2(f"x{n}", (50 + n, 50), sigmas=(30, 30)))
            window.change(Changes().marginalize(f"x{n - 2}"))
        variables, held, own = told(window)[0]
        assert (variables, own, len(held)) == (3, False, 3), "x0, x38, x39"
        before = window.chi2().chi2
        window.insert(Draft(), settle=True)
        assert window.chi2().chi2 <= before * (1 + 1e-9) < 50
