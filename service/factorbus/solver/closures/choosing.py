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
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from factorbus.solver.closures.evidence import ClosureNumbers, FalseSpread, judge_each, judge_pairs
from factorbus.solver.closures.policy import ClosurePolicy
from factorbus.solver.covariance.gates import threshold
from factorbus.solver.kernels.closures.sets import N_BETWEEN, list_believed, list_rivals, number_places, put_pairs
from factorbus.solver.kernels.jit.compile import F64, I64

PASSED, AGREES, UNSURE, IMPROBABLE, RIVAL = "passed", "agrees", "unsure", "improbable", "rival"
LEAST_RIVALS = 3  # that agree, against what the map says
_LEAST_CHANCE = 1e-12


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


@lru_cache(maxsize=64)
def limits_of(policy: ClosurePolicy, dims: int) -> ClosureLimits:
    """The limits of a policy."""
    probabilities = policy.closure_gate_probability, policy.closure_out_probability
    gate, out = (threshold(np.array([dims]), probability).item() for probability in probabilities)
    return ClosureLimits(gate, out, FalseSpread(policy.closure_spread_m, policy.closure_spread_rad))


class _Sets:
    """Sets of closures that agree.

    agree (n, n).  chances, twice (2, n, n): of each two near and anywhere, and their logarithms.  alone (n,): of each,
    anywhere.
    """

    def __init__(
        self, c: ClosureNumbers, gate: float, spreads: Sequence[FalseSpread], policy: ClosurePolicy, alone: F64
    ) -> None:
        n = len(c.z)
        i, j = _pairs(n)
        pairs = judge_pairs(c, i, j, spreads)
        self.agree, self.chances = np.empty((n, n), bool), (np.empty((2, n, n)), np.empty((2, n, n)))
        own = pairs.chance, np.log(np.maximum(pairs.chance, _LEAST_CHANCE))
        put_pairs(i, j, pairs.distance, gate, own, self.agree, self.chances)
        self.alone, self.poses, self.policy = np.ascontiguousarray(alone), (c.a, c.b), policy

    def believed(self, among: I64, odds: float) -> tuple[list[int], float]:
        """The largest one among some, or none where it may be chance, and its odds; odds: of mistakes.

        Of each member one other says so well where it is that a false one would hardly agree, and of each place the map
        or another place does: the members of one are one mistake, if they are one.  Places are those of members alone:
        others between them would make two places of one.
        """
        most = self.policy.closure_chance_max
        members, numbers = np.empty(among.size, np.int64), np.empty(N_BETWEEN + 2 * among.size)
        limits = odds, most, self.policy.closure_place_m
        count = list_believed(self.agree, among, self.chances, self.alone, self.poses, limits, members, numbers)
        if count < 2:
            return [], 1.0
        all_places, places, least, *logarithms = numbers.tolist()
        there = int(places)
        between, own = logarithms[: there - 1], logarithms[there - 1 : there + count - 2]
        logarithm = _sum(between) + math.log(max(least, _LEAST_CHANCE))
        by_mistake = _expected(max(int(all_places), there), there, logarithm)
        is_sure = self._is_set(own, count, among.size) and by_mistake <= most
        return (members[:count].tolist(), by_mistake) if is_sure else ([], 1.0)

    def rivals(self, among: I64) -> list[int]:
        """The largest one among some, three or more, that is not by chance of independent ones."""
        members, numbers = np.empty(among.size, np.int64), np.empty(among.size)
        count = list_rivals(self.agree, among, self.chances[1], members, numbers)
        if count < LEAST_RIVALS:
            return []
        return members[:count].tolist() if self._is_set(numbers[: count - 1].tolist(), count, among.size) else []

    def _is_set(self, logarithms: Sequence[float], size: int, count: int) -> bool:
        """Whether independent false ones, of as many, would hardly agree so."""
        return _expected(count, size, _sum(logarithms)) <= self.policy.closure_sets_max


@lru_cache(maxsize=128)
def _pairs(n: int) -> tuple[I64, I64]:
    """Each two of n."""
    i, j = np.triu_indices(n, 1)
    return i, j


def closure_places(a: F64, b: F64, within_m: float) -> I64:
    """(n,): the first of those before it, or itself, that is between the same two places; it is none of another's."""
    places = np.empty(len(a), np.int64)
    number_places(np.arange(len(a)), (a, b), within_m, places)
    return places


def _sum(logarithms: Sequence[float]) -> float:
    """One after the other, as they come."""
    total = 0.0
    for each in logarithms:
        total += each
    return total


def _expected(n: int, m: int, logarithm: float) -> float:
    return math.exp(min(math.log(math.comb(n, m)) + logarithm, 0.0))
