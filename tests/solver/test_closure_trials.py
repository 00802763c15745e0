"""What is believed of several closures at one place, and which of those that are in make room for them."""

import math

import numpy as np
from tested_maps import between, corridor

from factorbus.proto.messages import Batch
from factorbus.solver.closures.choosing import ClosureOdds, choose_closures
from factorbus.solver.closures.evidence import ClosureNumbers
from factorbus.solver.closures.gated import GatedSolver
from factorbus.solver.closures.ledger import ACCEPTED, SUSPECT
from factorbus.solver.closures.policy import ClosurePolicy

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


def test_one_that_is_sure_is_not_believed_ahead_of_others_that_speak_against_it() -> None:
    weight = np.diag(np.full(3, 0.08**-2))[np.triu_indices(3)][None]
    (false,) = closure(10, LENGTH, [0.0, 0.8, math.pi]).factors
    true = [between(k, 2 * LENGTH + 1 - k, [0.0, 0.0, math.pi])._replace(information=weight) for k in (9, 8)]
    apart = driven(LENGTH)
    apart.insert(Batch((), (false,)))
    apart.insert(Batch((), tuple(true)))
    assert [c.reason for c in apart.closures] == ["passed", "improbable", "improbable"]
    made = driven(LENGTH)
    made.insert(Batch((), (false, *true)))
    assert [c.reason for c in made.closures] == ["contradicted", "agrees", "agrees"]


def burst(at: list[float], off: float, common: float) -> ClosureNumbers:
    """Closures of poses at x, all seen `off` to the side; their second poses are `common` metres unsure together."""
    n = len(at)
    poses = np.tile(np.eye(3), (n, 1, 1))
    poses[:, 0, 2] = at
    z = np.tile(np.eye(3), (n, 1, 1))
    z[:, 1, 2] = off
    known = np.zeros((n, 6, n, 6))
    known[:, [3, 4], :, [3, 4]] = common**2
    return ClosureNumbers(poses, poses, z, np.tile(np.diag([4e-4] * 3), (n, 1, 1)), known.reshape(6 * n, 6 * n))


def test_a_burst_is_one_place_whatever_else_is_near() -> None:
    """Places are told apart among the members of a set, not among all that are looked at."""
    policy, chosen = ClosurePolicy(), list[list[str]]()
    near, far = [20.0 + k for k in range(6)], [60.0 + k for k in range(6)]
    for at in (near, [11.0, 33.0, *near], [*near, *far]):
        c = burst(at, 8.5, 2.0)
        if len(at) == 8:
            c.z[:2, 1, 2] = 7.0, 7.5  # others, on both sides of it, that agree with nothing
        chosen.append(choose_closures(c, 40.0, policy, ClosureOdds()).reasons[-6:])
    assert chosen[0] == chosen[1] == ["rival"] * 6
    assert chosen[2] == ["agrees"] * 6, "of two places each speaks for the other"


def test_a_place_that_the_map_is_sure_of_brings_no_other_with_it_that_hardly_agrees() -> None:
    near, far = [20.0 + k for k in range(3)], [60.0 + k for k in range(3)]
    c = burst([*near, *far], 0.0, 0.1)
    c.z[3:, 1, 2] = 12.0
    known = c.known.reshape(6, 6, 6, 6)
    known[3:] = known[:, :, 3:] = 0.0
    for k in (3, 4):
        known[3:, k, 3:, k] = 25.0  # the far ones hang together, and by little on the rest
    known[3:, 5, 3:, 5] = 0.04
    found = choose_closures(c, 40.0, ClosurePolicy(), ClosureOdds(), True)
    assert found.reasons[:3] == ["passed"] * 3
    assert not {"agrees", "passed"} & set(found.reasons[3:]), found
