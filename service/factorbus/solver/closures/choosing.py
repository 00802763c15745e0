"""Which of some closures are believed: each by itself, or several that agree.

    passed       within the gate, and hardly so if it were false
    agrees       one of a set that agrees, as false ones do not by chance (below)
    unsure       within the gate, and may well be false
    improbable   outside the gate
    rival        that too, and others agree with it: they are one mistake, or the map is wrong

How likely it is that one is false follows from the odds of its residual, times those of closures to be false at all.

A set is the largest of which each two agree.  Chance is excluded twice.  Among n independent false closures, off by up
to the policy's spread, C(n, m) Π p sets like it are expected: p the odds of one that agrees with one before it, over
the tree of the least likely agreements.  And mistakes bring several closures with them, as two corridors that look
alike do, and lead anywhere in the map: of n places C(n, m) q Π p agree, q the odds of the first one, times those of
such mistakes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from factorbus.solver.closures.evidence import ClosureNumbers, FalseSpread, judge_each, judge_pairs
from factorbus.solver.closures.policy import ClosurePolicy
from factorbus.solver.covariance.gates import threshold
from factorbus.solver.kernels.jit.compile import F64, I64

PASSED, AGREES, UNSURE, IMPROBABLE, RIVAL = "passed", "agrees", "unsure", "improbable", "rival"
LEAST_RIVALS = 3  # that agree, against what the map says
_LEAST_CHANCE = 1e-12
_MOST_BRANCHES = 20_000


class ClosureOdds(NamedTuple):
    """Before anything is known of it.  false: of a closure to be false; mistaken: of several at one place to be."""

    false: float = 1.0
    mistaken: float = 1.0


@dataclass(frozen=True, slots=True)
class Chosen:
    """What each of n closures is: one of the reasons above; d²; and the odds that it is false, even ones before: of its
    residual, or of the set that is believed.

    rivals: those outside the gate that agree with each other: the map may be wrong.
    allowed (n, d, d): S of each.
    """

    reasons: list[str]
    distance: F64
    chance: F64
    rivals: list[int]
    allowed: F64


def choose_closures(
    c: ClosureNumbers, extent_m: float, policy: ClosurePolicy, odds: ClosureOdds, all_together: bool = False
) -> Chosen:
    """Judge `c`; extent_m: half the length of the map, where mistakes may lead.

    all_together: sets are of those that pass by themselves, too, so that all have the odds of their set.
    """
    gate, out, own = limits_of(policy, c.noise.shape[1])
    spreads = (own, FalseSpread(max(extent_m, own.metres), math.pi))
    each = judge_each(c, spreads)
    within = each.distance <= gate
    sure = within & (odds.false * each.chance[:, 0] <= policy.closure_chance_max)
    reasons = [PASSED if s else UNSURE if w else IMPROBABLE for s, w in zip(sure, within, strict=True)]
    if len(within) == 1:  # which nothing agrees with
        return Chosen(reasons, each.distance, each.chance[:, 0].copy(), [], each.allowed)
    sets = _Sets(c, gate, spreads, policy, each.chance[:, 1])
    among = np.flatnonzero((~sure | all_together) & (each.distance <= out))
    members, of_set = sets.believed(among, odds.mistaken)
    chance = each.chance[:, 0].copy()
    for k in members:
        reasons[k], chance[k] = reasons[k] if sure[k] else AGREES, min(of_set, chance[k])
    rivals = sets.rivals(np.flatnonzero(~within))
    for k in rivals:
        reasons[k] = RIVAL if reasons[k] == IMPROBABLE else reasons[k]
    return Chosen(reasons, each.distance, chance, rivals, each.allowed)


class ClosureLimits(NamedTuple):
    """What a policy comes to for residuals of some numbers: d² of the gate, and d² beyond which one is improbable
    whatever agrees with it; how far off independent false ones are."""

    gate: float
    out: float
    spread: FalseSpread


def limits_of(policy: ClosurePolicy, dims: int) -> ClosureLimits:
    """The limits of a policy."""
    probabilities = policy.closure_gate_probability, policy.closure_out_probability
    gate, out = (threshold(np.array([dims]), probability).item() for probability in probabilities)
    return ClosureLimits(gate, out, FalseSpread(policy.closure_spread_m, policy.closure_spread_rad))


class _Sets:
    """Sets of closures that agree.

    agree (n, n), chance (n, n, spreads): of each two.  alone (n,): of each, anywhere.
    """

    def __init__(
        self, c: ClosureNumbers, gate: float, spreads: Sequence[FalseSpread], policy: ClosurePolicy, alone: F64
    ) -> None:
        n = len(c.z)
        i, j = np.triu_indices(n, 1)
        pairs = judge_pairs(c, i, j, spreads)
        self.agree, self.chance = np.zeros((n, n), bool), np.ones((n, n, len(spreads)))
        self.agree[i, j] = self.agree[j, i] = pairs.distance <= gate
        self.chance[i, j] = self.chance[j, i] = pairs.chance
        self.alone, self.numbers, self.policy = alone, c, policy

    def believed(self, among: I64, odds: float) -> tuple[list[int], float]:
        """The largest one among some, or none where it may be chance, and its odds; odds: of mistakes.

        Of each member one other says so well where it is that a false one would hardly agree, and of each place the map
        or another place does: the members of one are one mistake, if they are one.
        """
        members, most = self._largest(among), self.policy.closure_chance_max
        while members.size > 1:
            sure = self.chance[np.ix_(members, members)][..., 0].min(axis=1) <= most
            if not sure.all():
                members = members[sure]
                continue
            # Of members alone: others between them would make two places of one.
            chance, own = self.chance[np.ix_(members, members)], self._places(members)
            there, place = np.unique(own, return_inverse=True)
            alone = np.array([odds * self.alone[members[own == p]].min() for p in there])
            # Of two places the two that are the least likely to agree.
            between = np.array([[chance[own == p][:, own == q, 1].min() for q in there] for p in there])
            np.fill_diagonal(between, np.inf)
            held = np.minimum(alone, odds * between.min(axis=1)) <= most
            if not held.all():
                members = members[held[place]]
                continue
            logarithm = _chain(between) + math.log(max(float(alone.min()), _LEAST_CHANCE))
            count = max(np.unique(self._places(among)).size, there.size)
            by_mistake = _expected(count, there.size, logarithm)
            is_sure = self._is_set(members, among.size) and by_mistake <= most
            return (members.tolist(), by_mistake) if is_sure else ([], 1.0)
        return [], 1.0

    def rivals(self, among: I64) -> list[int]:
        """The largest one among some, three or more, that is not by chance of independent ones."""
        members = self._largest(among)
        if members.size < LEAST_RIVALS:
            return []
        return members.tolist() if self._is_set(members, among.size) else []

    def _is_set(self, members: I64, count: int) -> bool:
        """Whether independent false ones, of as many, would hardly agree so."""
        logarithm = _chain(self.chance[np.ix_(members, members)][..., 0])
        return _expected(count, members.size, logarithm) <= self.policy.closure_sets_max

    def _places(self, rows: I64) -> I64:
        return closure_places(self.numbers.a[rows], self.numbers.b[rows], self.policy.closure_place_m)

    def _largest(self, among: I64) -> I64:
        return among[largest_agreeing(self.agree[np.ix_(among, among)])]


def largest_agreeing(agree: np.ndarray) -> I64:
    """The members, ascending, of a largest set of which each agrees with each other one; agree (n, n), symmetric.

    Branch and bound, for a few dozens.  Of several equal ones the same at every call.
    """
    n = len(agree)
    order = sorted(range(n), key=lambda v: (-int(agree[v].sum()), v))
    near = {v: {u for u in order if agree[v, u] and u != v} for v in order}
    best: list[int] = []
    stack = [([], order)]
    for _ in range(_MOST_BRANCHES):
        if not stack:
            break
        members, left = stack.pop()
        if len(members) > len(best):
            best = members
        if left and len(members) + len(left) > len(best):
            first, rest = left[0], left[1:]
            stack.append((members, rest))
            stack.append(([*members, first], [u for u in rest if u in near[first]]))
    return np.array(sorted(best), np.int64)


def closure_places(a: F64, b: F64, within_m: float) -> I64:
    """(n,): the first of those before it, or itself, that is between the same two places; it is none of another's."""
    near = [np.linalg.norm(T[:, None, :-1, -1] - T[None, :, :-1, -1], axis=-1) <= within_m for T in (a, b)]
    same, number = near[0] & near[1], np.arange(len(a))
    for k in range(len(number)):
        first = np.flatnonzero(same[k, : k + 1] & (number[: k + 1] == np.arange(k + 1)))
        number[k] = first[0]
    return number


def _chain(chance: F64) -> float:
    """Σ ln p over the tree that joins all of n by the least likely agreements; chance (n, n)."""
    logarithm = np.log(np.maximum(chance, _LEAST_CHANCE))
    nearest, total = logarithm[0].copy(), 0.0
    nearest[0] = np.inf
    for _ in range(1, len(chance)):
        k = int(nearest.argmin())
        total += float(nearest[k])
        nearest = np.where(np.isinf(nearest), np.inf, np.minimum(nearest, logarithm[k]))
        nearest[k] = np.inf
    return total


def _expected(n: int, m: int, logarithm: float) -> float:
    return math.exp(min(math.log(math.comb(n, m)) + logarithm, 0.0))
