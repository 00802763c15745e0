"""A robot that begins in a frame of its own, in the map of the others, and is attached when enough candidates agree."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naive.dense_factors import pose_matrix
from two_maps import SEEN, Drive
from two_parts import SIGMAS, between_parts, drafted, drives, fill

from factorbus.cli.output.exits import REFUSED
from factorbus.client import AbsoluteFactors, CannotMerge, Changes, Draft, Map, attach, connect


def how_far_off(hall: Map, one: Drive, other: Drive) -> float:
    """The largest distance of any pose of the second robot from where it is, seen from where the first began."""
    begin, dim = np.linalg.inv(one.truth[0]), one.truth.shape[1] - 1
    places = [(begin @ T)[:dim, dim] for T in other.truth]
    return max(float(np.linalg.norm(hall.estimate[f"y{n}"][:dim] - place)) for n, place in enumerate(places))


@pytest.mark.parametrize("kind", ["se2", "se3"])
@pytest.mark.parametrize("closures", ["trust", "test", "robust"])
def test_a_robot_is_attached_when_enough_agree_and_not_before(endpoint: str, kind: str, closures: str) -> None:
    one, other, candidates = drives(kind, 5, 10, 14)
    name = f"hall-{kind}-{closures}"
    with connect(endpoint, client="matcher", timeout_s=60) as bus:
        bus.create(name, closures=closures)
        with bus.map(name) as hall:
            fill(hall, one)
            fill(hall, other, "y")
            before, came, joined = hall.estimate["y10"], 0, None
            for came in range(2, len(candidates) + 1):
                joined = attach(hall, "y", drafted(kind, candidates[:came]), settle=True)
                if joined.accepted:
                    break
                assert joined.alignment.verdict in ("too_few", "ambiguous")
                np.testing.assert_array_equal(hall.estimate["y10"], before)
            assert joined is not None
            assert joined.accepted is not None
            assert joined.left_out == {"fixed": 1}
            agree = [candidates[k] for k in joined.alignment.agree]
            assert all(each.is_right for each in agree)
            assert len(agree) >= 3
            assert joined.accepted.report["chi2"] < 2.0 * hall.stats()["factors"]
            assert how_far_off(hall, one, other) < 3.0
            # The robot drives on in the frame of all.
            hall.insert(
                Draft()
                .variable(kind, "y60")
                .factor(f"between_{kind}", ["y59", "y60"], other_step(kind), sigmas=SEEN[kind])
            )
            with pytest.raises(CannotMerge, match="joined to the rest already, by between_"):
                attach(hall, "y", drafted(kind, candidates))


def other_step(kind: str) -> list[float]:
    return [1.0, 0.0, 0.0] if kind == "se2" else [1.0, 0, 0, 0, 0, 0, 1.0]


def test_what_a_robot_sends_meanwhile_goes_along(endpoint: str) -> None:
    """The poses that come between the question and the insert are not among those that are brought over."""
    one, other, candidates = drives("se2", 7, 10, 5)
    with connect(endpoint, client="matcher", timeout_s=60) as bus, bus.map("hall-m") as hall:
        fill(hall, one)
        fill(hall, other, "y")
        asked, graph = hall.graph, hall.graph()

        def graph_of_before(timeout_s: float | None = None) -> object:
            del timeout_s
            last = graph.batch.variables
            hall.insert(Draft().se2("y60").between_se2("y59", "y60", (1, 0, 0), sigmas=SIGMAS))
            hall.graph = asked  # type: ignore[method-assign]
            return graph if last else None

        hall.graph = graph_of_before  # type: ignore[method-assign,assignment]
        joined = attach(hall, "y", drafted("se2", candidates), settle=True)
        assert joined.accepted is not None
        ahead = pose_matrix(hall.estimate["y59"]) @ [1, 0, 1]
        np.testing.assert_allclose(hall.estimate["y60"][:2], ahead[:2], atol=1e-3)
        assert joined.accepted.report["chi2"] < 2.0 * hall.stats()["factors"]


def test_what_knows_more_of_its_frame_is_refused_unless_that_may_go(endpoint: str) -> None:
    one, other, candidates = drives("se2", 8, 10, 0)
    with connect(endpoint, client="matcher", timeout_s=60) as bus, bus.map("hall-g") as hall:
        fill(hall, one)
        fill(hall, other, "y")
        hall.insert(
            Draft()
            .position_se2("y5", (5, 0), sigmas=(1, 1))
            .point2("m1")
            .landmark_se2("y7", "m1", (2, 0.1), sigmas=(0.1, 0.1))
        )
        revision = hall.estimate.revision
        with pytest.raises(AbsoluteFactors, match=r"1 fixed, 1 position_se2.*absolute=.leave_out. attaches") as refused:
            attach(hall, "ym", drafted("se2", candidates))
        assert "keep" not in str(refused.value), "which attach has not"
        for letters, said in (
            ("z", "no variable with letter z; .* of those there are: m, x, y"),
            ("mz", "no variable with letter z"),
            ("mxy", "with other letters"),
            ("", "letters is empty"),
        ):
            with pytest.raises(CannotMerge, match=said):
                attach(hall, letters, drafted("se2", candidates))
        with pytest.raises(CannotMerge, match="joined to the rest already, by landmark_se2"):
            attach(hall, "y", drafted("se2", candidates), absolute="leave_out")
        with pytest.raises(CannotMerge, match="absolute is 'keep'"):
            attach(hall, "ym", drafted("se2", candidates), absolute="keep")
        assert hall.estimate.revision == revision
        joined = attach(hall, "ym", drafted("se2", candidates), absolute="leave_out", settle=True)
        assert joined.left_out == {"fixed": 1, "position_se2": 1}
        seen = np.linalg.inv(pose_matrix(hall.estimate["y7"])) @ [*hall.estimate["m1"], 1]
        np.testing.assert_allclose(seen[:2], [2, 0.1], atol=1e-3)
        assert how_far_off(hall, one, other) < 3.0


def test_a_part_that_a_weak_prior_holds_ends_where_a_merge_of_two_maps_does(endpoint: str) -> None:
    one, other, candidates = drives("se2", 9, 8, 6)
    with connect(endpoint, client="matcher", timeout_s=60) as bus:
        with bus.map("hall-w") as hall:
            fill(hall, one)
            fill(hall, other, "y")
            hall.insert(Draft().prior_se2("y0", (0, 0, 0), sigmas=(10, 10, 3)), changes=Changes().free("y0"))
            joined = attach(hall, "y", drafted("se2", candidates), settle=True)
            assert joined.left_out == {"prior_se2": 1}
            attached = values_of(hall)
        with bus.map("hall-v") as hall, bus.map("yard-v") as yard:
            fill(hall, one)
            fill(yard, other)
            hall.merge(yard, anchors=joined.alignment.anchors(), letters={"x": "y"}, settle=True)
            merged = values_of(hall)
    assert attached.keys() == merged.keys()
    for key, value in attached.items():
        np.testing.assert_allclose(value, merged[key], atol=1e-5)


def test_what_marginalize_left_of_a_prior_goes_as_a_prior_does(endpoint: str) -> None:
    """And what it left of relative poses alone turns with the part: the estimate is that of a merge."""
    one, other, candidates = drives("se2", 9, 8, 6)
    tidy = Changes().free("y0"), Changes().marginalize("y0"), Changes().marginalize("y30", "y31")
    with connect(endpoint, client="matcher", timeout_s=60) as bus:
        with bus.map("hall-l") as hall, bus.map("yard-l") as yard:
            for into in (hall, yard):
                fill(into, other, "y")
                into.insert(Draft().prior_se2("y0", (0, 0, 0), sigmas=(1, 1, 1)))
                for changes in tidy:
                    into.change(changes)
            fill(hall, one)
            kept = [each for each in candidates if each.b not in (0, 30, 31)]
            joined = attach(hall, "y", drafted("se2", kept), absolute="leave_out", settle=True)
            assert joined.left_out
            assert all(name.startswith("linear") for name in joined.left_out)
            hall.settle()
            attached, chi2 = values_of(hall), hall.chi2().chi2
        with bus.map("hall-k") as hall, bus.map("yard-l") as yard:
            fill(hall, one)
            hall.merge(yard, anchors=joined.alignment.anchors(), absolute="leave_out", settle=True)
            hall.settle()
            merged = values_of(hall)
            assert chi2 == pytest.approx(hall.chi2().chi2, rel=1e-6)
    assert attached.keys() == merged.keys()
    for key, value in attached.items():
        np.testing.assert_allclose(value, merged[key], atol=1e-3)


def test_of_two_that_attach_one_part_at_once_the_second_is_refused(endpoint: str) -> None:
    """Else the candidates would be in the map twice, and count twice."""
    one, other, candidates = drives("se2", 5, 10, 8)
    with connect(endpoint, client="matcher", timeout_s=60) as bus, bus.map("hall-t") as hall:
        fill(hall, one)
        fill(hall, other, "y")
        insert, before = hall.insert, hall.stats()["factors"]
        with connect(endpoint, client="again", timeout_s=60) as others, others.map("hall-t") as same:

            def insert_behind(*arguments: Any, **options: Any) -> Any:
                hall.insert = insert  # type: ignore[method-assign]
                assert attach(same, "y", drafted("se2", candidates)).accepted
                return insert(*arguments, **options)

            hall.insert = insert_behind  # type: ignore[method-assign]
            with pytest.raises(CannotMerge, match="joined to the rest already"):
                attach(hall, "y", drafted("se2", candidates))
        assert between_parts(hall) == hall.stats()["factors"] - before == 10


def test_what_of_a_part_hangs_on_no_candidate_is_named(endpoint: str) -> None:
    """Nobody measured where it is: it is not carried along."""
    one, other, candidates = drives("se2", 5, 10, 4)
    with connect(endpoint, client="matcher", timeout_s=60) as bus, bus.map("hall-c") as hall:
        fill(hall, one)
        fill(hall, other, "y")
        hall.insert(Draft().se2("z0").prior_se2("z0", (0, 0, 0), sigmas=SIGMAS))
        hall.insert(Draft().se2("z1").between_se2("z0", "z1", (1, 0, 0), sigmas=SIGMAS))
        revision = hall.estimate.revision
        with pytest.raises(CannotMerge, match="no factor joins z0, z1 to a pose of a candidate that agrees"):
            attach(hall, "yz", drafted("se2", candidates), absolute="leave_out")
        assert hall.estimate.revision == revision
        assert attach(hall, "y", drafted("se2", candidates)).accepted
        np.testing.assert_array_equal(hall.estimate["z0"], (0, 0, 0))


def test_a_candidate_that_is_none_is_named(endpoint: str) -> None:
    one, other, _ = drives("se2", 5, 10, 4)
    with connect(endpoint, client="matcher", timeout_s=60) as bus, bus.map("hall-n") as hall:
        fill(hall, one)
        fill(hall, other, "y")
        hall.insert(Draft().se2(7).prior_se2(7, (0, 0, 0), sigmas=SIGMAS))
        for a, b, said in (
            ("x900", "y1", r"candidates name x900, no se2 in the map's frame.*`Map\.estimate`"),
            ("y2", "y1", r"two poses of one side: \(y2, y1\)"),
            ("x2", "x1", r"two poses of one side: \(x2, x1\)"),
        ):
            with pytest.raises(CannotMerge, match=said):
                attach(hall, "y", Draft().between_se2(a, b, (0, 0, 0), sigmas=SIGMAS))
        with pytest.raises(CannotMerge, match=r"there are: none \(keys that are a number\), x, y"):
            attach(hall, "q", Draft().between_se2("x1", "y1", (0, 0, 0), sigmas=SIGMAS))


def test_candidates_that_the_map_tests_already_are_not_counted_twice(endpoint: str) -> None:
    one, other, candidates = drives("se2", 5, 10, 8)
    with connect(endpoint, client="matcher", timeout_s=60) as bus:
        bus.create("hall-d", closures="test")
        with bus.map("hall-d") as hall:
            fill(hall, one)
            fill(hall, other, "y")
            hall.insert(drafted("se2", candidates[:6]))
            suspects = hall.suspects()
            with pytest.raises(CannotMerge, match=r"tests candidates that agree already.*remove_factors\(\["):
                attach(hall, "y", drafted("se2", candidates))
            hall.change(Changes().remove_factors(suspects.factors))
            assert attach(hall, "y", drafted("se2", candidates)).accepted
            assert between_parts(hall) == 10


def values_of(hall: Map) -> dict[int, np.ndarray]:
    found: dict[int, np.ndarray] = {}
    for group in hall.ask_estimate().variables:
        assert group.values is not None
        found |= dict(zip(group.keys.tolist(), group.values, strict=True))
    return found


def command(endpoint: str, *rest: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-P", "-m", "factorbus.cli", "change", "attach", "--connect", endpoint, *rest]
    return subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)


def test_from_a_shell(endpoint: str, tmp_path: Path) -> None:
    one, other, candidates = drives("se2", 6, 9, 9)
    with connect(endpoint, client="matcher", timeout_s=60) as bus, bus.map("hall-s") as hall:
        fill(hall, one)
        fill(hall, other, "y")
        lines = [f"x{c.a} y{c.b} {','.join(map(str, c.z))}" for c in candidates]
        few, all_of_them = tmp_path / "few.txt", tmp_path / "all.txt"
        few.write_text("\n".join(lines[:1]))
        all_of_them.write_text("\n".join(lines))
        sigmas = ("--sigmas", ",".join(map(str, SIGMAS)))
        told = command(endpoint, "hall-s", "y", str(few), *sigmas)
        assert told.returncode == REFUSED
        assert "not_aligned" in told.stderr
        told = command(endpoint, "hall-s", "y", str(all_of_them), *sigmas, "--settle", "--json")
        assert told.returncode == 0, told.stderr
        found = json.loads(told.stdout)
        assert (found["alignment"], found["left_out_fixed"]) == ("aligned", 1)
        hall.settle()
        assert how_far_off(hall, one, other) < 3.0
        again = command(endpoint, "hall-s", "y", str(all_of_them), *sigmas)
        assert again.returncode == REFUSED
        assert "cannot_merge" in again.stderr
