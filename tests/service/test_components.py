"""Which parts of a map no factor joins, found from a copy of it: against a search from variable to variable."""

import numpy as np
import pytest

from factorbus.client import Draft
from factorbus.proto.components import COMPONENTS_LISTED, Component, Components, decode_components, encode_components
from factorbus.proto.linear_in_frame import said_of_frame
from factorbus.proto.messages import Batch, Factors, MapGraph, Variables
from factorbus.proto.problems import BadMessage
from factorbus.proto.symbols import format_symbol, symbol
from factorbus.service.questions.components import components_of_map

SIGMAS = (0.1, 0.1, 0.1)


def found_in(draft: Draft | Batch) -> Components:
    batch = draft.batch() if isinstance(draft, Draft) else draft
    return components_of_map(MapGraph(1, 2, batch))


def told(component: Component) -> tuple[str, int, int, dict[str, int], dict[str, int], bool]:
    return (format_symbol(component.first), *(getattr(component, name) for name in Component.__slots__[1:]))


def test_two_robots_and_what_holds_each() -> None:
    draft = Draft().se2("a0", (0, 0, 0), fixed=True).se2("a1").se2("a2").point2("l4")
    draft.between_se2("a0", "a1", (1, 0, 0), sigmas=SIGMAS).between_se2("a1", "a2", (1, 0, 0), sigmas=SIGMAS)
    draft.landmark_se2("a2", "l4", (1, 1), sigmas=(0.1, 0.1))
    draft.se2("b7").se2("b8").prior_se2("b8", (0, 0, 0), sigmas=SIGMAS)
    draft.between_se2("b7", "b8", (1, 0, 0), sigmas=SIGMAS)
    found = found_in(draft)
    assert (found.epoch, found.revision, found.count, found.in_no_frame) == (1, 2, 2, 0)
    assert [told(each) for each in found.listed] == [
        ("a0", 4, 3, {"a": 3, "l": 1}, {"fixed": 1}, True),
        ("b7", 2, 2, {"b": 2}, {"prior_se2": 1}, True),
    ]


def test_what_says_more_than_where_it_begins_is_in_no_frame_of_its_own() -> None:
    draft = Draft().se2("a0", (0, 0, 0), fixed=True).se2("a1").between_se2("a0", "a1", (1, 0, 0), sigmas=SIGMAS)
    draft.position_se2("a1", (1, 0), sigmas=(1, 1))
    draft.point2("l1", (3, 3), fixed=True)  # a beacon that nobody has seen yet
    found = found_in(draft)
    assert [(each.held, each.own_frame) for each in found.listed] == [
        ({"fixed": 1, "position_se2": 1}, False),
        ({"fixed": 1}, False),
    ]


def test_a_mount_and_a_bias_in_common_join_nothing() -> None:
    draft = Draft().se2("m0", (0.1, 0, 0))
    draft.prior_se2("m0", (0.1, 0, 0), sigmas=SIGMAS)
    for robot in "ab":
        draft.se2(f"{robot}0", (0, 0, 0), fixed=True).se2(f"{robot}1")
        draft.between_se2(f"{robot}0", f"{robot}1", (1, 0, 0), sigmas=SIGMAS, mount="m0")
    found = found_in(draft)
    assert (found.count, found.in_no_frame) == (2, 1)
    assert [each.held for each in found.listed] == [{"fixed": 1}] * 2, "the mount's prior holds no robot"


@pytest.mark.parametrize(("kind", "pose"), [("se2", (1, 2, 0.5)), ("se3", (1, 2, 3, 0, 0, 0.6, 0.8))])
def test_what_a_linear_factor_says_of_the_frame_is_in_its_numbers(kind: str, pose: tuple[float, ...]) -> None:
    """With H of a prior on one pose it holds its part, beside all else; with H of a relative pose it does not."""
    dim = 3 if kind == "se2" else 6
    draft = Draft().variable(kind, "a0", pose, fixed=True).variable(kind, "a1", pose)
    draft.variable(kind, "b0", pose).variable(kind, "b1", pose)
    sigmas, nothing = [0.1] * dim, [0.0] * dim
    draft.linear(["a0", "a1"], [pose, pose], [-np.eye(dim), np.eye(dim)], nothing, sigmas=sigmas)
    draft.linear(["b0", "b1"], [pose, pose], [np.zeros((dim, dim)), np.eye(dim)], nothing, sigmas=sigmas)
    found = found_in(draft)
    name = f"linear_{dim}_{kind}_{kind}"
    assert [(each.held, each.own_frame) for each in found.listed] == [({"fixed": 1}, True), ({name: 1}, False)]
    draft.linear(["a1"], [pose], [np.eye(dim)], nothing, sigmas=sigmas)
    found = found_in(draft)
    assert (found.listed[0].held, found.listed[0].own_frame) == ({"fixed": 1, f"linear_{dim}_{kind}": 1}, False)


@pytest.mark.parametrize(
    ("H", "place"),
    [
        (np.eye(6)[3:5], False),  # roll and pitch: which way is up
        (np.eye(6)[3:], True),  # all of the rotation
        (np.eye(6)[:1], True),  # one coordinate, far from the origin: a lever of 10⁶ m turns it as well
        (np.eye(6)[2:5], True),  # a height too
    ],
)
def test_which_way_is_up_is_no_place(H: np.ndarray, place: bool) -> None:
    pose = (5e6, 4e5, 100, 0, 0, 0, 1)
    draft = Draft().se3("a0", pose).linear(["a0"], [pose], [H], np.zeros(len(H)), sigmas=[0.1] * len(H))
    group = draft.batch().factors[0]
    said = said_of_frame(group, [[""]])
    assert (said.anything.tolist(), said.place.tolist()) == ([True], [place])
    assert bool(found_in(draft).listed[0].held) is place
    alone = said_of_frame(group, [["mount"]])
    assert not alone.anything.any(), "a mount moves with no frame"


def test_an_empty_map_has_none() -> None:
    assert found_in(Batch()) == Components(1, 2)


@pytest.mark.parametrize("seed", range(20))
def test_against_a_search_from_variable_to_variable(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 60)), int(rng.integers(0, 60))
    names = rng.choice(np.concatenate([np.arange(500), np.arange(500) | symbol("x", 0), [-7]]), n, replace=False)
    edges = names[rng.integers(n, size=(m, 2))]
    edges = edges[edges[:, 0] != edges[:, 1]]
    groups = tuple(Variables("se2", half, np.zeros((half.size, 3))) for half in np.array_split(names, 2))
    factors = Factors("between_se2", edges, np.zeros((len(edges), 3)), np.zeros((len(edges), 6)))
    found = found_in(Batch(groups, (factors,)))
    wanted = searched(names.tolist(), edges.tolist())
    assert found.count == len(wanted)
    assert [(each.first, each.variables) for each in found.listed] == sorted(
        ((min(part), len(part)) for part in wanted), key=lambda each: (-each[1], each[0])
    )
    assert sum(each.factors for each in found.listed) == len(edges)


def searched(names: list[int], edges: list[list[int]]) -> list[set[int]]:
    parts, left = [], set(names)
    while left:
        part = {left.pop()}
        while more := {b for pair in edges for a, b in (pair, pair[::-1]) if a in part} - part:
            part |= more
        left -= part
        parts.append(part)
    return parts


def test_the_largest_are_listed_and_all_counted() -> None:
    many = COMPONENTS_LISTED + 5
    found = found_in(Batch((Variables("se2", np.arange(many), np.zeros((many, 3)), True),)))
    assert (found.count, len(found.listed), found.listed[-1].first) == (many, COMPONENTS_LISTED, COMPONENTS_LISTED - 1)


def test_both_ways_as_bytes() -> None:
    found = Components(1, 2, 3, (Component(-5, 2, 1, {"": 2}, {"fixed": 1}, True),), 4)
    assert decode_components(encode_components(found)) == found
    for part, said in ((b"\xa5first", "components.first"), (b"\xa5count", "count")):
        with pytest.raises(BadMessage, match=said):
            decode_components(encode_components(found).replace(part, part[:-1] + b"X"))
