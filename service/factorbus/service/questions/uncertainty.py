"""Questions about uncertainty, answered from R at one revision: covariances, gates, associations, gains, and why.

A few variables are looked up in R where it lies, between two steps: a path to the root, microseconds.  For more R is
copied there, and the answer computed on the thread that sends it.  One copy serves all questions about its revision.
What an answer comes to is known before anything is allocated for it (`costs`).
"""

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from factorbus.proto import asking, asking_codec
from factorbus.proto.arrays import F64, I64
from factorbus.proto.asking import Associated, CovarianceGroup, Covariances, Gained, Gated, Why
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Factors
from factorbus.proto.problems import Problem, TooLarge
from factorbus.proto.symbols import format_symbol
from factorbus.service.questions import costs
from factorbus.service.questions.question_memory import Room, Taken
from factorbus.solver.covariance.association import associate
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.candidates import Candidates, evaluate_candidates
from factorbus.solver.covariance.gates import threshold
from factorbus.solver.covariance.relative import relative
from factorbus.solver.covariance.square_root import SquareRoot
from factorbus.solver.covariance.why import why_factor, why_variable
from factorbus.solver.errors import NotFinite, UnknownVariable
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import variables_aside
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE, VARIABLE_KINDS
from factorbus.solver.kernels.model import layout as at

# Measured on city10000: a path to the root takes 0.1 ms, a copy of R 5 ms.
NEAR = 8  # variables of the questions that are answered, between two steps, from R where it lies
_ENDS = 2  # of a factor, at most
_MOST = 100_000  # candidates, or pairs of observation and landmark, in one question: some 100 MB of Jacobians
_MOST_FACTORS = 10_000  # of a variable that is asked about: some seconds
_OF_AN_EXPLANATION = 100  # numbers that the explanation of a factor comes to, with its names, at most
_SMALLEST = min(kind.dim for kind in VARIABLE_KINDS.values())
_NAMED = 4  # keys in the text of an error
_UNBOUNDED = Room()

DECODE: Mapping[str, Callable[[bytes], Any]] = {
    "covariance": asking_codec.decode_ask_covariance,
    "gate": asking_codec.decode_ask_gate,
    "gain": asking_codec.decode_ask_gain,
    "associate": asking_codec.decode_ask_associate,
    "why": asking_codec.decode_ask_why,
}


def near_variables(ask: Any) -> int:
    """How many variables the answer goes up from, where it is sooner made between two steps than R is copied there.

    0: R is copied.
    """
    count = 0
    if isinstance(ask, asking.AskCovariance):
        named = [0 if keys is None else keys.size for keys in (ask.keys, ask.others)]
        count = 1 if ask.blocks == "last" else sum(named)
    elif isinstance(ask, asking.AskGate | asking.AskGain):
        count = _ENDS * sum(len(group.keys) for group in ask.factors)
    elif isinstance(ask, asking.AskWhy) and ask.factor is not None:
        count = _ENDS
    return count if count <= NEAR else 0


class MissingVariables(Problem):
    """A question about a variable that the map does not have."""

    code = "unknown_variable"

    def __init__(self, keys: Iterable[int], candidate: str = "") -> None:
        """candidate: the factor that might be inserted, and is on it."""
        missing = [int(key) for key in keys]
        names = ", ".join(map(format_symbol, missing[:5]))
        shown = names + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        seen = f"{candidate}: there is no variable {shown}" if candidate else f"the map has no {shown}"
        super().__init__(f"{seen}; the map's estimate has those there are", key=missing[0], keys=missing[:100])


class NoPose(Problem):
    """A question about the last pose of a map that has none."""

    code = "unknown_variable"

    def __init__(self) -> None:
        super().__init__("the map has no pose yet: ask again when one is inserted")


class Uncertain:
    """R at one revision.  Threads take turns: candidates are put into the graph, and taken out again.

    make: gives R, when the first answer needs it.  keeps_steps: the solver notes when each variable moved.  reported:
    of the last step.  room: for answers.
    """

    def __init__(
        self,
        make: Callable[[], SquareRoot],
        epoch: int,
        revision: int,
        keeps_steps: bool,
        reported: Mapping[str, Any],
        room: Room = _UNBOUNDED,
    ) -> None:
        self._make, self._room = make, room
        self._made: CovarianceBlocks | None = None
        self._when = epoch, revision
        self._keeps_steps, self._last_report = keeps_steps, reported
        self._turn = threading.Lock()

    @property
    def _blocks(self) -> CovarianceBlocks:
        """Raises SolverError."""
        if self._made is None:
            self._made = CovarianceBlocks(self._make())
        return self._made

    @property
    def _graph(self) -> FactorGraph:
        return self._blocks.factored.graph

    def answer(self, ask: Any) -> bytes:
        """The bytes of the answer.  Raises Problem, SolverError."""
        with self._turn, self._room.taken() as taken:
            return _ANSWER[type(ask)](self, ask, taken)

    def covariance(self, ask: asking.AskCovariance, taken: Taken) -> bytes:
        """ask/covariance"""
        if ask.blocks == "diagonal":
            every = np.arange(self._blocks.factored.count) if ask.keys is None else self._find(ask.keys)
            return self._grouped("diagonal", every, taken)
        if ask.blocks == "last":
            return self._grouped("last", self._last_pose(), taken)
        keys = np.empty(0, np.int64) if ask.keys is None else ask.keys
        if ask.blocks == "relative":
            first, second = self._find(keys.reshape(-1)).reshape(-1, 2).T
            width = self._blocks.width
            self._afford(costs.of_candidates(self._blocks, len(first), width * width + width + 3), taken)
            found = relative(self._blocks, np.ascontiguousarray(first), np.ascontiguousarray(second))
            groups = [CovarianceGroup(each.kind, keys[each.rows], each.covariance, each.values) for each in found]
            return asking_codec.encode_covariances(Covariances(*self._when, "relative", tuple(groups)))
        return self._together(ask.blocks, keys, ask.others, taken)

    def gate(self, ask: asking.AskGate, taken: Taken) -> bytes:
        """ask/gate"""
        found = self._judge(ask.factors, 3, taken)
        allowed = threshold(found.dims, ask.probability)
        plausible = found.distance <= allowed
        return asking_codec.encode_gated(Gated(*self._when, found.distance, found.dims, allowed, plausible))

    def gain(self, ask: asking.AskGain, taken: Taken) -> bytes:
        """ask/gain"""
        found = self._judge(ask.factors, 1, taken)
        return asking_codec.encode_gained(Gained(*self._when, found.gain))

    def associate(self, ask: asking.AskAssociate, taken: Taken) -> bytes:
        """ask/associate"""
        pose = int(self._find(np.array([ask.pose]))[0])
        landmarks = self._landmarks(ask.kind) if ask.landmarks is None else self._find(np.unique(ask.landmarks))
        pairs = len(ask.measured) * landmarks.size
        _check_size("the question", pairs, _MOST, "pairs of observation and landmark")
        self._afford(costs.of_candidates(self._blocks, pairs, 3), taken)

        def weigh(variables: I64, numbers: int) -> None:
            taken.take(costs.of_joint_innovations(self._blocks, variables, numbers))

        found = associate(
            self._blocks, ask.kind, pose, ask.measured, ask.information, landmarks, ask.probability, weigh
        )  # fmt: skip
        matched = found.landmark >= 0
        allowed = float(threshold(np.array([found.dims]), ask.probability)[0]) if found.dims else 0.0
        return asking_codec.encode_associated(
            Associated(
                *self._when,
                np.where(matched, self._graph.keys[found.landmark], 0),
                matched,
                found.distance,
                found.dims,
                allowed,
                found.complete,
                found.observations,
                self._graph.keys[found.landmarks],
                found.distances,
            )
        )

    def why(self, ask: asking.AskWhy, taken: Taken) -> bytes:
        """ask/why"""
        variable: dict[str, Any] = {}
        factor: dict[str, Any] = {}
        if ask.key is not None:
            index = int(self._find(np.array([ask.key]))[0])
            count = self._graph.count_factors(index)
            _check_size("the explanation of this variable", count, _MOST_FACTORS, "factors")
            self._afford(costs.of_candidates(self._blocks, count, _OF_AN_EXPLANATION), taken)
            variable = why_variable(self._blocks, index, self._keeps_steps).as_dict()
        elif ask.factor is not None:
            factor = why_factor(self._blocks, ask.factor).as_dict()
        return asking_codec.encode_why(Why(*self._when, variable, factor, self._last_report))

    def _judge(self, factors: Sequence[Factors], numbers: int, taken: Taken) -> Candidates:
        """Without their losses: a gate is to judge the measurement as it is.  numbers: that are answered of each."""
        count = sum(len(group.keys) for group in factors)
        _check_size("the question", count, _MOST, "candidates")
        self._afford(costs.of_candidates(self._blocks, count, numbers), taken)
        plain = [Factors(group.kind, group.keys, group.measured, group.information) for group in factors]
        try:
            return evaluate_candidates(self._blocks, plain)
        except UnknownVariable as unknown:
            raise MissingVariables([unknown.key], unknown.factor) from None

    def _afford(self, cost: costs.Cost, taken: Taken) -> None:
        """Raises TooLarge, OutOfMemory."""
        self._room.fits("the answer", cost.answer)
        taken.take(cost.memory)

    def _grouped(self, blocks: str, variables: I64, taken: Taken) -> bytes:
        """Blocks of single variables, by kind."""
        self._afford(costs.of_blocks(self._blocks, variables), taken)
        found, graph, groups = self._blocks.of(variables), self._graph, []
        codes = graph.var[variables, at.V_KIND]
        for code in np.unique(codes).tolist():
            rows, kind = np.flatnonzero(codes == code), VARIABLE_KIND_OF_CODE[code]
            covariance = found[rows, : kind.dim, : kind.dim]
            _check_finite(covariance, graph.keys[variables[rows]])
            groups.append(CovarianceGroup(kind.name, graph.keys[variables[rows]], covariance))
        return asking_codec.encode_covariances(Covariances(*self._when, blocks, tuple(groups)))

    def _together(self, blocks: str, keys: I64, others: I64 | None, taken: Taken) -> bytes:
        """One matrix: of all keys, or between keys and others."""
        rows = self._find(keys)
        columns = rows if others is None or blocks == "joint" else self._find(others)
        dims, other_dims = self._blocks.factored.dims[rows], self._blocks.factored.dims[columns]
        self._afford(costs.of_matrix(self._blocks, rows, columns), taken)
        covariance = self._blocks.between(rows, columns)
        _check_finite(covariance[None], keys[None])
        if blocks == "joint":
            return asking_codec.encode_covariances(
                Covariances(*self._when, blocks, (), keys, dims, covariance=covariance)
            )
        return asking_codec.encode_covariances(
            Covariances(*self._when, blocks, (), keys, dims, others, other_dims, covariance)
        )

    def _find(self, keys: I64) -> I64:
        """Indices of variables.  Raises MissingVariables."""
        found = np.array([self._graph.find(int(key)) for key in keys], np.int64)
        if (found < 0).any():
            raise MissingVariables(np.unique(keys[found < 0]).tolist())
        return found

    def _last_pose(self) -> I64:
        """The newest that is in the map: no mount of a sensor, no other frame.  Raises NoPose."""
        poses = [VARIABLE_KINDS[name].code for name in ("se2", "se3", "sim3")]
        kinds, counts = self._graph.var[: self._blocks.factored.count, at.V_KIND], self._graph.counts
        aside = variables_aside(self._graph.fac[: counts[at.FACTORS]]).tolist()
        for v in range(kinds.size - 1, -1, -1):
            if kinds[v] in poses and v not in aside:
                return np.array([v])
        raise NoPose

    def _landmarks(self, kind: str) -> I64:
        code = VARIABLE_KINDS[FACTOR_KINDS[kind].connects[1]].code
        return np.flatnonzero(self._graph.var[: self._blocks.factored.count, at.V_KIND] == code)


def _check_finite(covariances: F64, keys: I64) -> None:
    """Raises NotFinite for the first of `covariances` (n, d, d) that is not, which is of the key, or the keys, keys[n].

    R of a map whose information goes over more than double precision has may have pivots that are next to nothing.
    """
    bad = np.flatnonzero(~np.isfinite(covariances).all(axis=(1, 2)))
    if bad.size:
        raise NotFinite(f"the covariance of {', '.join(map(format_symbol, np.ravel(keys[bad[0]])[:_NAMED].tolist()))}")


def check_keys(ask: Any, room: Room) -> None:
    """Could a client receive the answer, if every variable were of the smallest kind?  Raises TooLarge."""
    if isinstance(ask, asking.AskCovariance) and ask.blocks in ("joint", "cross") and ask.keys is not None:
        others = ask.keys if ask.blocks == "joint" or ask.others is None else ask.others
        room.fits("the answer", 8 * _SMALLEST * _SMALLEST * ask.keys.size * others.size)


def _check_size(what: str, count: int, most: int, unit: str) -> None:
    if count > most:
        raise TooLarge(what, count, most, unit, "ask for less at a time")


_ANSWER: Mapping[type, Callable[[Uncertain, Any, Taken], bytes]] = {
    asking.AskCovariance: Uncertain.covariance,
    asking.AskGate: Uncertain.gate,
    asking.AskGain: Uncertain.gain,
    asking.AskAssociate: Uncertain.associate,
    asking.AskWhy: Uncertain.why,
}
