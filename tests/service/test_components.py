"""Which parts of a map no factor joins, found from a copy of it: against a search from variable to variable."""

import numpy as np
import pytest

from factorbus.client import Draft
from factorbus.proto.components import COMPONENTS_LISTED, Component, Components, decode_components, encode_components
from factorbus.proto.kinds import FACTOR_KINDS
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


def test_linear_factors_count_where_nothing_else_holds_it() -> None:
    linear = FACTOR_KINDS["linear_3_se2"]
    z = np.tile(np.array(linear.example), (1, 1))
    draft = Draft().se2("a0", (0, 0, 0), fixed=True).se2("b0").batch()
    rows = [Factors(linear.name, np.array([[key]]), z, np.ones((1, linear.information_size))) for key in keys("a0 b0")]
    found = found_in(Batch(draft.variables, tuple(rows)))
    assert [(each.held, each.own_frame) for each in found.listed] == [
        ({"fixed": 1}, True),
        ({"linear_3_se2": 1}, False),
    ]


def keys(names: str) -> list[int]:
    return [symbol(name[0], int(name[1:])) for name in names.split()]


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
