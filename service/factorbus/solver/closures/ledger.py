"""All closures that a map was given, as columns, and what has become of each.

A closure that is not believed keeps its factor's id, and is no factor of the map meanwhile: it is kept here.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from factorbus.solver.closures.choosing import IMPROBABLE, RIVAL, ClosureOdds
from factorbus.solver.closures.motions import motions_of_poses
from factorbus.solver.closures.naming import NotAClosure
from factorbus.solver.graph.arenas import with_room
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import FactorGroup, FactorsLike
from factorbus.solver.kernels.jit.compile import F64, I64

ACCEPTED, SUSPECT, REJECTED, RESTORED = "accepted", "suspect", "rejected", "restored"
CLOSURE_STATES: tuple[str, ...] = (ACCEPTED, SUSPECT, REJECTED, RESTORED)
NEW, BY_USER, FAILED, OUTWEIGHED = "new", "user", "failed", "outweighed"
POSES_BETWEEN = {"between_se2": 3, "between_se3": 7}  # numbers of a pose
BELIEVED = {ACCEPTED, RESTORED}
_ROOM = 256  # closures, from the first: to make more means new pages for ten columns
_BURST = 10  # closures that one mistake brings
_COLUMNS = ("z", "noise", "bound", "ends", "looked", "is_suspect", "is_new", "is_tested", "is_improbable", "is_rival")


@dataclass(slots=True, eq=False)
class Closure:
    """One closure.

    factor_id: its id, whether it is in or not; row: in its ledger.  came, changed: revisions, when it came, and when
    its state last changed.  reason: why its state is what it is.  distance: d², chance: the odds of its residual, both
    when it was last looked at.  tried: the newest rival when it was last taken out on trial.
    is_weighed: it has a loss, as a suspect that is not outweighed too, and `chance` is its weight (`graduation`).
    """

    factor_id: int
    row: int
    factor: FactorsLike
    came: int
    state: str = SUSPECT
    reason: str = NEW
    distance: float = float("nan")
    chance: float = float("nan")
    changed: int = 0
    tried: int = -1
    is_weighed: bool = False

    @property
    def is_in(self) -> bool:
        """Whether it is a factor of the map."""
        return self.would_be_in(self.state, self.reason)

    def would_be_in(self, state: str, reason: str) -> bool:
        """Whether it is one in this state for this reason."""
        return state in BELIEVED or (self.is_weighed and state == SUSPECT and reason != OUTWEIGHED)

    @property
    def keys(self) -> tuple[int, int]:
        """The poses it is between."""
        first, second = self.factor.keys[0].tolist()
        return first, second


class ClosureVerdicts(NamedTuple):
    """What closures are from now on, each (n,): ids, states, reasons, d², chances, and rivals that were tried."""

    factors: I64
    states: tuple[str, ...]
    reasons: tuple[str, ...]
    distance: F64
    chance: F64
    tried: I64


_NONE: I64 = np.empty(0, np.int64)
NO_VERDICTS = ClosureVerdicts(_NONE, (), (), np.empty(0), np.empty(0), _NONE)


class Ledger:
    """Closures of one kind.  What is in rows behind them means nothing: it may be of a batch whose step failed.

    z (n, k, k), noise (n, d, d): what was measured, and Ω⁻¹ in its tangent space, metres and radians.
    bound (n, d, d): rᵀ W r is no less than d² of one that is in, and no more than that of a suspect, for as long as the
    map only gets factors, to first order; NaN: not known.  Nothing but work depends on it.
    ends (n, 2): variables.  is_suspect, is_tested (n,): whether it may go in, and whether it is in and may go out;
    is_new, is_improbable, is_rival (n,): a suspect for that reason, rivals are improbable, too; accepted, improbable,
    rivals: how many are in, and are that.
    looked (n,): when it was last looked at, in looks.  All columns have room behind for more.
    count: how many there are.  unlisted: those that nobody has asked for since they came.
    """

    def __init__(self, kind: str) -> None:
        self.kind, self.size, self.dim = kind, POSES_BETWEEN[kind], 3 if kind == "between_se2" else 6
        self._listed: list[Closure] = []
        self.unlisted: list[Sequence[Closure]] = []
        k, d = 3 if self.dim == 3 else 4, self.dim
        self.z, self.noise, self.bound = np.zeros((0, k, k)), np.zeros((0, d, d)), np.zeros((0, d, d))
        self.ends, self.looked = np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
        self.is_suspect, self.is_new, self.is_tested = (np.zeros(0, bool) for _ in range(3))
        self.is_improbable, self.is_rival = np.zeros(0, bool), np.zeros(0, bool)
        self.accepted = self.improbable = self.rivals = self.count = 0

    @property
    def closures(self) -> list[Closure]:
        """By their rows."""
        if self.unlisted:
            unlisted, self.unlisted = self.unlisted, []
            for new in unlisted:
                self._listed += new
        return self._listed

    def add(self, closure: Closure, ends: Sequence[int], looked: int) -> None:
        """One more."""
        n = closure.row = self.count
        self.make_room(1)
        self.closures.append(closure)
        self.count += 1
        self.ends[n], self.looked[n], self.is_tested[n] = ends, looked, False
        self.mark(closure)
        self.measure(closure, closure.factor)

    def enter(self, new: Sequence[Closure], looked: int) -> None:
        """Several more, which `foresee_closures` has measured in the rows behind."""
        for row, closure in enumerate(new, self.count):
            closure.row, is_in = row, closure.state == ACCEPTED
            self.looked[row] = looked + is_in
            self.is_suspect[row] = self.is_new[row] = closure.state == SUSPECT
            self.is_tested[row] = is_in
            self.accepted += is_in
        self.count += len(new)
        self.closures.extend(new)

    def make_room(self, more: int) -> None:
        """For `more` rows behind those in use."""
        if (need := self.count + more) > len(self.z):
            need = max(need, _ROOM)
            for name in _COLUMNS:
                setattr(self, name, with_room(getattr(self, name), need))

    def measure(self, closure: Closure, factor: FactorsLike) -> None:
        """What it measures, and how well."""
        closure.factor = factor
        self.z[closure.row] = motions_of_poses(factor.measured)[0]
        self.noise[closure.row], self.bound[closure.row] = _noise(factor, self.dim), np.nan

    def mark(self, closure: Closure) -> None:
        """Its state has changed."""
        row, is_suspect = closure.row, closure.state == SUSPECT
        if self.is_suspect[row] and not is_suspect and not closure.is_weighed:  # Ω S Ω, of S when it was a suspect
            weight = np.linalg.inv(self.noise[row])
            self.bound[row] = weight @ np.linalg.inv(self.bound[row]) @ weight
        elif self.is_suspect[row] != is_suspect:
            self.bound[row] = np.nan
        is_tested, is_rival = closure.state == ACCEPTED, is_suspect and closure.reason == RIVAL
        is_improbable = is_rival or (is_suspect and closure.reason == IMPROBABLE)
        self.accepted += is_tested - bool(self.is_tested[row])
        self.improbable += is_improbable - bool(self.is_improbable[row])
        self.rivals += is_rival - bool(self.is_rival[row])
        self.is_suspect[row], self.is_tested[row], self.is_improbable[row] = is_suspect, is_tested, is_improbable
        self.is_rival[row] = is_rival
        self.is_new[row] = is_suspect and closure.reason == NEW

    def odds(self, share: float = 1.0) -> ClosureOdds:
        """By those that have come (Laplace's rule), and even at most.

        Improbable ones count as false, those that are in as right; as mistakes that bring several at one place, rivals.
        share: of the improbable ones without rivals, how many count.
        """
        mistaken = _BURST + self.rivals
        return ClosureOdds(self.odds_false(share), min(mistaken / (_BURST + self.accepted), 1.0))

    def odds_false(self, share: float = 1.0) -> float:
        """The first of them alone."""
        alone = self.improbable - self.rivals
        return min((1 + self.rivals + share * alone) / (1 + self.accepted), 1.0)

    def suspects(self) -> I64:
        """Rows."""
        return np.flatnonzero(self.is_suspect[: self.count])

    def tested(self) -> I64:
        """Rows."""
        return np.flatnonzero(self.is_tested[: self.count])

    def unjudged(self) -> I64:
        """Rows of suspects that nobody has looked at."""
        return np.flatnonzero(self.is_new[: self.count])


class ClosureLedger:
    """All closures of a map, in the order in which they came.

    looks: how often some were looked at.  moved_at: the look at which some went in or out last.  weighs: closures are
    weighed by losses.
    """

    def __init__(self, weighs: bool = False) -> None:
        self._weighs = weighs
        self.of_kind = {kind: Ledger(kind) for kind in POSES_BETWEEN}
        self._of_factor: dict[int, Closure] = {}
        self._unlisted: list[Sequence[Closure]] = []
        self.looks = self.moved_at = 0
        self._counts: dict[str, int] = dict.fromkeys(CLOSURE_STATES, 0)

    @property
    def of_factor(self) -> dict[int, Closure]:
        """All by the ids of their factors."""
        if self._unlisted:
            unlisted, self._unlisted = self._unlisted, []
            self._of_factor.update((c.factor_id, c) for new in unlisted for c in new)
        return self._of_factor

    @property
    def closures(self) -> list[Closure]:
        """All of them."""
        return list(self.of_factor.values())

    def counts(self) -> dict[str, int]:
        """How many are in each state."""
        return dict(self._counts)

    def add(self, factor: FactorsLike, factor_id: int, graph: FactorGraph, revision: int) -> Closure:
        """A new one: a suspect that nobody has looked at."""
        closure = Closure(factor_id, 0, factor, revision, changed=revision, is_weighed=self._weighs)
        self.of_kind[factor.kind].add(closure, [graph.find(key) for key in closure.keys], self.looks)
        self.of_factor[factor_id] = closure
        self._counts[SUSPECT] += 1
        return closure

    def enter(self, kind: str, new: Sequence[Closure]) -> None:
        """New ones of a kind, which `foresee_closures` has measured; of those that are in that is a look."""
        self.of_kind[kind].enter(new, self.looks)
        if any(closure.is_in for closure in new):
            self.looks += 1
            self.moved_at = self.looks
        self.of_factor.update((closure.factor_id, closure) for closure in new)
        for closure in new:
            self._counts[closure.state] += 1

    def enter_expected(self, kind: str, new: Sequence[Closure], count: int) -> None:
        """The same of several, `count`, that are all accepted, and know their rows: listed when somebody asks for any.

        `looked` and `is_tested` are written, too.
        """
        ledger = self.of_kind[kind]
        self.looks = self.moved_at = self.looks + 1
        ledger.accepted += count
        ledger.count += count
        ledger.unlisted.append(new)
        self._unlisted.append(new)
        self._counts[ACCEPTED] += count

    @property
    def suspect_count(self) -> int:
        """How many are suspects."""
        return self._counts[SUSPECT]

    def named(self, factors: Iterable[int]) -> list[Closure]:
        """Those with these ids.  Raises NotAClosure."""
        found = []
        for factor in factors:
            if (closure := self.of_factor.get(factor)) is None:
                raise NotAClosure(factor, len(self.of_factor))
            found.append(closure)
        return found

    def said(self, factors: Iterable[int], state: str) -> ClosureVerdicts:
        """That a user has the last word on these: `state` for good.  Raises NotAClosure."""
        named = self.named(factors)
        return verdicts_of((c, state, BY_USER, c.distance, c.chance, c.tried) for c in named)

    def failed(self, verdicts: ClosureVerdicts) -> ClosureVerdicts:
        """The same where the step that they asked for failed: what was to go in is a suspect, the rest stays."""
        rows = []
        for k, c in enumerate(self.named(verdicts.factors.tolist())):
            state, reason = verdicts.states[k], verdicts.reasons[k]
            if (state in BELIEVED) != c.is_in:
                state, reason = (c.state, c.reason) if c.is_in else (SUSPECT, FAILED)
            rows.append((c, state, reason, verdicts.distance[k], verdicts.chance[k], int(verdicts.tried[k])))
        return verdicts_of(rows)

    def note(self, verdicts: ClosureVerdicts, revision: int) -> list[Closure]:
        """They are so from now on; gives those whose state is another, and new ones.  Raises NotAClosure."""
        self.looks += 1
        changed, moved, lost = [], False, False
        for k, c in enumerate(self.named(verdicts.factors.tolist())):
            was, is_new, ledger = (c.state, c.is_in), c.reason == NEW, self.of_kind[c.factor.kind]
            c.state, c.reason, c.tried = verdicts.states[k], verdicts.reasons[k], int(verdicts.tried[k])
            c.distance, c.chance = float(verdicts.distance[k]), float(verdicts.chance[k])
            ledger.looked[c.row] = self.looks
            ledger.mark(c)
            if c.state != was[0]:
                self._counts[was[0]] -= 1
                self._counts[c.state] += 1
                c.changed = revision
            if c.state != was[0] or is_new:
                changed.append(c)
            moved, lost = moved or c.is_in != was[1], lost or (was[1] and not c.is_in)
        if moved:
            self.moved_at = self.looks
        for ledger in self.of_kind.values() if lost else ():
            ledger.bound[:] = np.nan
        return changed

    def measure(self, closure: Closure, factor: FactorsLike) -> None:
        """What it measures, and how well: a loss by which the map weighs it is none of its own."""
        if closure.is_weighed and closure.state in (ACCEPTED, SUSPECT):
            factor = FactorGroup(factor.kind, factor.keys, factor.measured, factor.information)
        self.of_kind[factor.kind].measure(closure, factor)

    def forget(self, gone: Iterable[int], graph: FactorGraph) -> None:
        """Those with these ids are no more, and variables of the map may have other numbers."""
        for factor in gone:
            self._counts[self.of_factor.pop(factor).state] -= 1
        looked = {c.factor_id: int(self.of_kind[c.factor.kind].looked[c.row]) for c in self.of_factor.values()}
        self.of_kind = {kind: Ledger(kind) for kind in POSES_BETWEEN}
        for c in self.of_factor.values():
            self.of_kind[c.factor.kind].add(c, [graph.find(key) for key in c.keys], looked[c.factor_id])

    def dump(self) -> dict[str, Any]:
        """All of it, as plain values."""
        all_ = self.closures
        state: dict[str, Any] = {"looks": self.looks, "moved_at": self.moved_at}
        for name in ("factor_id", "came", "changed", "tried"):
            state[name] = np.array([getattr(c, name) for c in all_], np.int64)
        for name in ("state", "reason"):
            state[name] = [getattr(c, name) for c in all_]
        state |= {name: np.array([getattr(c, name) for c in all_], np.float64) for name in ("distance", "chance")}
        state["looked"] = np.array([self.of_kind[c.factor.kind].looked[c.row] for c in all_], np.int64)
        state["kind"], state["loss"] = [c.factor.kind for c in all_], [c.factor.loss for c in all_]
        scales = [c.factor.scale for c in all_]
        state["scale"] = np.array([0.0 if scale is None else float(scale[0]) for scale in scales])
        state["keys"] = np.array([c.keys for c in all_], np.int64).reshape(-1, 2)
        for name in ("measured", "information"):
            state[name] = np.concatenate([np.empty(0), *(getattr(c.factor, name)[0] for c in all_)])
        return state

    def load(self, state: Mapping[str, Any], graph: FactorGraph) -> None:
        """Be what one was that gave `state`, of this graph.  Raises KeyError, ValueError."""
        self.__init__(self._weighs)
        self.looks, self.moved_at = int(state["looks"]), int(state["moved_at"])
        here = {"measured": 0, "information": 0}
        for k, kind in enumerate(state["kind"]):
            numbers = []
            for name, size in (("measured", 3 if kind == "between_se2" else 7), ("information", _TRIANGLES[kind])):
                numbers.append(np.array(state[name][here[name] : here[name] + size]).reshape(1, size))
                here[name] += size
            loss = state["loss"][k]
            scale = np.array([float(state["scale"][k])]) if loss else None
            factor = FactorGroup(kind, np.array(state["keys"][k : k + 1]), numbers[0], numbers[1], loss, scale)
            ids = [int(state[name][k]) for name in ("factor_id", "came", "changed", "tried")]
            told = state["state"][k], state["reason"][k], float(state["distance"][k]), float(state["chance"][k])
            closure = Closure(ids[0], 0, factor, ids[1], *told, ids[2], ids[3], self._weighs)
            self.of_kind[kind].add(closure, [graph.find(key) for key in closure.keys], int(state["looked"][k]))
            self.of_factor[closure.factor_id] = closure
            self._counts[closure.state] += 1


_TRIANGLES = {"between_se2": 6, "between_se3": 21}


def verdicts_of(rows: Iterable[tuple[Closure, str, str, float, float, int]]) -> ClosureVerdicts:
    """(closure, state, reason, d², chance, tried) of each, as columns."""
    listed = list(rows)
    return ClosureVerdicts(
        np.array([row[0].factor_id for row in listed], np.int64),
        tuple(row[1] for row in listed),
        tuple(row[2] for row in listed),
        np.array([row[3] for row in listed], np.float64),
        np.array([row[4] for row in listed], np.float64),
        np.array([row[5] for row in listed], np.int64),
    )


def _noise(factor: FactorsLike, d: int) -> F64:
    """Ω⁻¹ in metres and radians: the residual of a rotation in space is half its angle."""
    omega = np.zeros((d, d))
    rows, columns = np.triu_indices(d)
    omega[rows, columns] = omega[columns, rows] = factor.information[0]
    if d == 6:
        halves = np.array([1.0] * 3 + [0.5] * 3)
        omega *= halves[:, None] * halves
    return np.asarray(np.linalg.inv(omega), np.float64)
