"""Two maps on a service, matches of which more than half are false, and one map in the end."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from naive.dense_factors import pose_matrix
from two_maps import SEEN, Candidate, Drive, two_drives

from factorbus.client import AmbiguousAlignment, CannotMerge, Draft, Map, NotAligned, align, connect
from factorbus.client.aligning import _two_digits

LETTERS = {"x": "y"}
KIND, SIGMAS = "se2", SEEN["se2"].tolist()


def drafted(candidates: list[Candidate], turned: bool = False, mixed: bool = False) -> Draft:
    """mixed: every other one has a loss, so that a message has them in another order."""
    draft = Draft()
    for k, each in enumerate(candidates):
        T = pose_matrix(each.z)
        z = each.z
        if turned:
            T = np.linalg.inv(T)
            z = np.array([*T[:2, 2], np.arctan2(T[1, 0], T[0, 0])])
        pair = [f"x{each.a}", f"y{each.b}"]
        loss = "huber" if mixed and k % 2 == 0 else None
        draft.factor(f"between_{KIND}", pair[::-1] if turned else pair, z, sigmas=SIGMAS, loss=loss)
    return draft


def drives(seed: int, right: int, wrong: int, grouped: int) -> tuple[Drive, Drive, list[Candidate]]:
    return two_drives(KIND, 80, (right, wrong), grouped, np.random.default_rng(seed))


def fill(into: Map, of: Drive) -> None:
    for step in of.steps:
        into.send(step)
    into.flush()


def how_far_off(hall: Map, one: Drive, other: Drive) -> float:
    """The largest distance of any pose of the second robot from where it is, seen from where the first began."""
    begin = np.linalg.inv(one.truth[0])
    places = [(begin @ T)[:2, 2] for T in other.truth]
    return max(float(np.linalg.norm(hall.estimate[f"y{n}"][:2] - place)) for n, place in enumerate(places))


def test_two_maps_become_one(endpoint: str) -> None:
    one, other, candidates = drives(1, 12, 20, 0)
    with connect(endpoint, client="merger", timeout_s=60) as bus, bus.map("hall-a") as hall, bus.map("yard-a") as yard:
        fill(hall, one)
        fill(yard, other)
        found = align(hall, yard, drafted(candidates), letters=LETTERS)
        assert found.verdict == "aligned"
        assert [candidates[k].is_right for k in found.agree] == [True] * 12
        assert str(found).startswith("12 of 32 agree, σ 0.")
        turned = align(hall, yard, drafted(candidates, turned=True), letters=LETTERS)
        assert turned.frame is not None
        assert turned.agree.tolist() == found.agree.tolist()
        mixed = align(hall, yard, drafted(candidates, mixed=True), letters=LETTERS)
        assert (mixed.agree.tolist(), mixed.reference) == (found.agree.tolist(), found.reference)
        pairs = [{tuple(ends) for g in each.anchors().factors for ends in g.keys.tolist()} for each in (found, mixed)]
        assert pairs[0] == pairs[1]
        # Their sigmas are along the axes of the other pose then.
        np.testing.assert_allclose(turned.frame, found.frame, atol=0.2)
        hall.merge(yard, anchors=found.anchors(), letters=LETTERS, settle=True)
        assert how_far_off(hall, one, other) < 3.0


def test_copies_of_a_candidate_are_no_further_candidates(endpoint: str) -> None:
    one, other, candidates = drives(3, 6, 4, 0)
    with connect(endpoint, client="merger", timeout_s=60) as bus, bus.map("hall-d") as hall, bus.map("yard-d") as yard:
        fill(hall, one)
        fill(yard, other)
        found = align(hall, yard, drafted(candidates), letters=LETTERS)
        wrong = next(each for each in candidates if not each.is_right)
        first = [wrong] * 50 + candidates + candidates
        again = align(hall, yard, drafted(first), letters=LETTERS)
        assert again.verdict == found.verdict == "aligned"
        assert "; 60 copies of others left out" in str(again)
        picked = [first[k] for k in again.agree]
        assert sorted((each.a, each.b) for each in picked) == sorted(
            (candidates[k].a, candidates[k].b) for k in found.agree
        )
        assert again.anchors().factor_count == len(found.agree)
        assert again.covariance is not None
        np.testing.assert_allclose(again.covariance, found.covariance, rtol=1e-6)


def test_what_is_ambiguous_or_too_little_is_not_merged(endpoint: str) -> None:
    one, other, candidates = drives(4, 10, 0, 9)
    with connect(endpoint, client="merger", timeout_s=60) as bus, bus.map("hall-b") as hall, bus.map("yard-b") as yard:
        fill(hall, one)
        fill(yard, other)
        found = align(hall, yard, drafted(candidates), letters=LETTERS)
        assert found.verdict == "ambiguous"
        assert "; ambiguous with a second set of" in str(found)
        with pytest.raises(AmbiguousAlignment) as refused:
            found.anchors()
        assert refused.value.code == "ambiguous_alignment"
        few = align(hall, yard, drafted(candidates[:1]), letters=LETTERS)
        assert (few.verdict, few.frame, str(few)) == ("too_few", None, "1 candidate, and none that it could agree with")
        with pytest.raises(NotAligned):
            few.anchors()
        before = hall.estimate.revision
        for bad, said in (
            (Draft(), "the candidates are nothing"),
            (Draft().se2("y900").between_se2("x0", "y900", (0, 0, 0), sigmas=SIGMAS), "se2"),
            (Draft().prior_se2("x0", (0, 0, 0), sigmas=SIGMAS), "prior_se2"),
            (Draft().between_se2("x0", "y900", (0, 0, 0), sigmas=SIGMAS), "names y900, which neither map has"),
            (Draft().between_se3("x0", "y1", (0, 0, 0, 0, 0, 0, 1), sigmas=(0.1,) * 6), "x0 and y1, .* of kind se3"),
            (Draft().between_se2("x0", "x1", (0, 0, 0), sigmas=SIGMAS), "two poses of one map"),
            (Draft().between_se2("x0", "y1", (0, 0, 0), information=np.diag([1.0, 1, 0])), "between x0, y1 is no rel"),
            (Draft().between_se2("x0", "y1", (0, 0, 0), sigmas=(1e100, 1, 1)), "between x0, y1 is no rel"),
        ):
            with pytest.raises(CannotMerge, match=said):
                align(hall, yard, bad, letters=LETTERS)
        with pytest.raises(CannotMerge, match="both maps have x0 and x1"):
            align(hall, yard, Draft().between_se2("x0", "x1", (0, 0, 0), sigmas=SIGMAS))
        assert hall.estimate.revision == before


def test_a_large_distance_is_said_without_an_exponent() -> None:
    assert [_two_digits(number) for number in (0.0123, 1.26, 99.4, 99.6, 174.0)] == ["0.012", "1.3", "99", "100", "174"]


def command(endpoint: str, *rest: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-P", "-m", "factorbus.cli", "change", "merge", "--connect", endpoint, *rest]
    return subprocess.run(line, capture_output=True, text=True, timeout=120)


def test_from_a_shell(endpoint: str, tmp_path: Path) -> None:
    one, other, candidates = drives(6, 8, 8, 0)
    with connect(endpoint, client="merger", timeout_s=60) as bus, bus.map("hall-c") as hall, bus.map("yard-c") as yard:
        fill(hall, one)
        fill(yard, other)
    file, sigmas = tmp_path / "matches.txt", ",".join(map(str, SIGMAS))
    lines = ["# pose, the other map's, where that is seen from this"]
    for n, each in enumerate(candidates):
        z = ",".join(map(repr, each.z.tolist()))
        lines.append(f"x{each.a} y{each.b} {z} {sigmas}" if n % 2 else f"x{each.a} y{each.b} {z}")
    file.write_text("\n".join(lines))
    asked = ["hall-c", "yard-c", "--letter", "x=y", "--align", str(file)]
    for wrong in (tmp_path / "none.txt", tmp_path):
        refused = command(endpoint, *asked[:-1], str(wrong))
        assert (refused.returncode, "Traceback" in refused.stderr) == (3, False)
        assert f"{wrong} cannot be read: " in refused.stderr
    without = command(endpoint, *asked)
    assert without.returncode == 2
    assert "line 2 does not say how certain it is" in without.stderr
    file.with_name("few.txt").write_text("\n".join(lines[:2]))
    few = command(endpoint, *asked[:-1], str(file.with_name("few.txt")), "--sigmas", sigmas)
    assert few.returncode not in (0, 2)
    assert "[not_aligned]" in few.stderr
    assert "Traceback" not in few.stderr
    done = command(endpoint, *asked, "--sigmas", sigmas)
    assert done.returncode == 0, done.stderr
    assert "8 of 16 agree" in done.stdout
    with connect(endpoint, client="looker", timeout_s=60) as bus, bus.map("hall-c") as hall:
        assert how_far_off(hall, one, other) < 3.0
