"""A part that was attached is taken apart again: in its own frame, as it was, with what came since."""

import numpy as np
import pytest
from naive.dense_factors import pose_matrix
from two_maps import SEEN
from two_parts import SIGMAS, Parts, between_parts, drafted, drives, fill, parts

from factorbus.client import AbsoluteFactors, CannotMerge, Changes, Draft, Map, Refused, attach, connect, undo_attach
from factorbus.client.changes import FactorsOfAnother
from factorbus.proto.symbols import symbol

AGREE = 10


@pytest.fixture(scope="module")
def both() -> Parts:
    return parts(5, AGREE, 8)


def values_of(hall: Map) -> dict[int, np.ndarray]:
    found: dict[int, np.ndarray] = {}
    for group in hall.ask_estimate().variables:
        assert group.values is not None
        found |= dict(zip(group.keys.tolist(), group.values, strict=True))
    return found


def check_apart(hall: Map, before: dict[int, np.ndarray], atol: float = 1e-6) -> None:
    """As if the part had never been attached."""
    hall.settle()
    after = values_of(hall)
    assert between_parts(hall) == 0
    for key, value in before.items():
        one, other = (pose_matrix(x) if x.size in (3, 7) else x for x in (after[key], value))
        np.testing.assert_allclose(one, other, atol=atol)


@pytest.mark.parametrize("kind", ["se2", "se3"])
@pytest.mark.parametrize("closures", ["trust", "test", "robust"])
def test_it_is_as_it_was_and_what_came_since_goes_along(endpoint: str, kind: str, closures: str) -> None:
    one, other, candidates = drives(kind, 5, AGREE, 8)
    with connect(endpoint, client="matcher", timeout_s=60) as bus:
        bus.create(f"hall-{kind}-{closures}", closures=closures)
        with bus.map(f"hall-{kind}-{closures}") as hall:
            fill(hall, one)
            fill(hall, other, "y")
            hall.settle()
            before, factors = values_of(hall), hall.stats()["factors"]
            joined = attach(hall, "y", drafted(kind, candidates), settle=True)
            assert joined.accepted
            assert abs(hall.estimate["y10"] - before[symbol("y", 10)]).max() > 0.1
            ahead = [1.0, 0, 0] if kind == "se2" else [1.0, 0, 0, 0, 0, 0, 1.0]
            hall.insert(
                Draft().variable(kind, "y60").factor(f"between_{kind}", ["y59", "y60"], ahead, sigmas=SEEN[kind])
            )
            undo_attach(hall, joined)
            np.testing.assert_array_equal(hall.estimate["y0"], before[symbol("y", 0)])
            check_apart(hall, before)
            assert hall.stats()["factors"] == factors + 1
            assert [dict(c.held) for c in hall.components().listed] == [{"fixed": 1}] * 2
            assert 0.9 < np.linalg.norm(hall.estimate["y60"][:2] - hall.estimate["y59"][:2]) < 1.1
            with pytest.raises(CannotMerge, match="10 are gone from the map: it was taken back already"):
                undo_attach(hall, joined)
            assert attach(hall, "y", drafted(kind, candidates)).accepted, "and attached again"


def test_priors_and_what_marginalize_left_come_back(endpoint: str, both: Parts) -> None:
    with connect(endpoint, client="matcher", timeout_s=60) as bus, bus.map("hall-p") as hall:
        both.fill(hall)
        hall.insert(Draft().prior_se2("y0", (0, 0, 0), sigmas=(1, 1, 1)), changes=Changes().free("y0"))
        hall.change(Changes().marginalize("y30", "y31"))
        hall.insert(Draft().position_se2("y50", hall.estimate["y50"][:2], sigmas=(0.5, 0.5)))
        hall.settle()
        before = values_of(hall)
        kept = [each for each in both.candidates if each.b not in (30, 31)]
        joined = attach(hall, "y", drafted("se2", kept), absolute="leave_out", settle=True)
        assert joined.left_out == {"prior_se2": 1, "position_se2": 1}
        undo_attach(hall, joined, settle=True)
        check_apart(hall, before, atol=1e-4)


def test_what_is_in_the_way_is_named_and_nothing_changes(endpoint: str, both: Parts) -> None:
    with connect(endpoint, client="matcher", timeout_s=60) as bus, bus.map("hall-w") as hall:
        both.fill(hall)
        with pytest.raises(CannotMerge, match="nothing was attached"):
            undo_attach(hall, attach(hall, "y", drafted("se2", both.candidates[:1])))
        joined = attach(hall, "y", both.draft(), settle=True)
        assert joined.accepted
        with bus.map("another") as another, pytest.raises(FactorsOfAnother, match="another"):
            undo_attach(another, joined)
        with pytest.raises(Refused, match="y0") as refused:  # which is not for this, and says so
            hall.change(Changes().undo(joined.alignment.anchors(), joined.accepted))
        assert refused.value.code == "underconstrained"
        more = hall.insert(Draft().between_se2("x9", "y9", (1, 1, 1), sigmas=SIGMAS))
        with pytest.raises(CannotMerge, match=r"by more than what attached it, by between_se2 \(x9, y9\)"):
            undo_attach(hall, joined)
        hall.change(Changes().remove_factors(more.first_factor))
        more = hall.insert(Draft().position_se2("y9", hall.estimate["y9"][:2], sigmas=(1, 1)))
        with pytest.raises(AbsoluteFactors, match=r"map's frame \(1 position_se2\)"):
            undo_attach(hall, joined)
        hall.change(Changes().remove_factors(more.first_factor))
        assert between_parts(hall) == AGREE
        hall.change(Changes().marginalize("y0"))
        with pytest.raises(CannotMerge, match="held in its own frame at y0, gone since"):
            undo_attach(hall, joined)
