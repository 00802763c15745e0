"""What is believed of several closures at one place, and which of those that are in make room for them."""

import math

import numpy as np
from tested_maps import between, corridor

from factorbus.proto.messages import Batch
from factorbus.solver.closures.gated import GatedSolver
from factorbus.solver.closures.ledger import ACCEPTED, SUSPECT

LENGTH = 40


def closure(k: int, length: int, z: list[float]) -> Batch:
    """Of pose k and where it is seen again."""
    return Batch((), (between(k, 2 * length + 1 - k, z),))


def driven(length: int) -> GatedSolver:
    made = GatedSolver()
    for batch in corridor(length):
        made.insert(batch)
    return made


def misled(z: list[float], key: int = 20) -> GatedSolver:
    """A long corridor, of which one closure is believed that is false."""
    made = driven(LENGTH)
    made.insert(closure(key, LENGTH, z))
    false = made.closures[0]
    assert (false.reason, false.is_in) == ("unsure", False)
    made.accept(false.factor_id)
    false.state, false.reason = ACCEPTED, "agrees"  # as if another false one had agreed with it
    made.ledger.of_kind["between_se2"].mark(false)
    return made


def test_rivals_at_one_place_replace_the_one_that_alone_holds_the_map_there() -> None:
    made = misled([0.3, 3.0, math.pi - 0.15])
    false, seen = made.closures[0], list[str]()
    for k in (18, 17, 16):
        made.insert(closure(k, LENGTH, [0.0, 0.0, math.pi]))
        seen.append(made.closures[-1].reason)
    assert seen == ["improbable", "improbable", "passed"], "two may be chance, three are not"
    assert (false.state, false.reason) == (SUSPECT, "contradicted")
    assert [c.is_in for c in made.closures] == [False, True, True, True]
    values = np.concatenate([group.values for group in made.solver.estimate() if not group.fixed])
    np.testing.assert_allclose(values[[9, 70], :2], [[10.0, 0.0], [10.0, 0.0]], atol=1e-3)
    made.insert(closure(15, LENGTH, [0.0, 0.0, math.pi]))
    assert [c.is_in for c in made.closures] == [False, True, True, True, True]


def test_rivals_at_one_place_do_not_replace_what_others_hold() -> None:
    made = driven(LENGTH)
    for k in (22, 20, 18):
        made.insert(closure(k, LENGTH, [0.0, 0.0, math.pi]))
    first = list(made.closures)
    assert all(c.is_in for c in first), [c.reason for c in first]
    for k in (12, 11, 10, 9):  # all of one mistake
        made.insert(closure(k, LENGTH, [0.5, 4.0, math.pi]))
    assert [c.reason for c in made.closures[-4:]] == ["rival"] * 4
    assert all(c.is_in for c in first)
    assert made.ledger.of_kind["between_se2"].odds().mistaken == 1.0, "such mistakes come"


def test_one_is_not_believed_that_more_of_its_batch_disagree_with() -> None:
    false, true = [0.0, 0.35, math.pi], [0.0, 0.0, math.pi]
    alone = driven(12)
    alone.insert(closure(2, 12, false))
    assert alone.closures[0].reason == "passed", "it would be, by itself"
    made = driven(12)
    factors = [closure(k, 12, z).factors[0] for k, z in ((2, false), (3, true), (4, true))]
    made.insert(Batch((), tuple(factors)))
    assert [c.is_in for c in made.closures] == [False, True, True], [(c.reason, c.chance) for c in made.closures]


def test_a_burst_is_one_place_whatever_else_is_near() -> None:
    """Places are told apart among the members of a set, not among all that are looked at."""
    made = driven(LENGTH)
    for k in (33, 32):
        made.insert(closure(k, LENGTH, [1.0, -6.0, math.pi]))
    for k in range(28, 22, -1):
        made.insert(closure(k, LENGTH, [0.0, 4.2, math.pi]))
    assert not any(c.is_in for c in made.closures), [(c.reason, c.distance, c.chance) for c in made.closures]
