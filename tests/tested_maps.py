"""A map that tests its closures, without a bus: what goes in, the records of its journal, and the same run again."""

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st

from factorbus.journal import chain
from factorbus.journal.records import JournalRecord, Last
from factorbus.proto import codec
from factorbus.proto.closures import CLOSURE_STATES, Suspects, decode_suspects
from factorbus.proto.messages import Batch, Change, Factors, Insert, Variables
from factorbus.proto.own_clients import JUDGE
from factorbus.service.config import Limits
from factorbus.service.core.events import Arrived, Outcome, Refuse, Stepped, Verdict
from factorbus.service.journal.library import make_map_solver
from factorbus.service.journal.recovery import arrived_again
from factorbus.service.journal.writing import written
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.arrival import read_insert

SIGMA = 0.02
WEIGHT = np.diag(np.full(3, SIGMA**-2))[np.triu_indices(3)][None]


def between(i: int, j: int, z: list[float], trusted: bool = False) -> Factors:
    return Factors("between_se2", np.array([[i, j]]), np.array([z]), WEIGHT, trusted=trusted)


def corridor(length: int) -> list[Batch]:
    """There and back again, a metre a pose, odometry without noise; pose 2 n − k + 1 is where pose k was, turned."""
    batches = [Batch((Variables("se2", np.array([0]), np.zeros((1, 3)), True),))]
    for k in range(1, 2 * length + 1):
        step = [0.0, 0.0, math.pi] if k == length + 1 else [1.0, 0.0, 0.0]
        batches.append(Batch((Variables("se2", np.array([k])),), (between(k - 1, k, step),)))
    return batches


def right(k: int, length: int) -> Factors:
    """The closure of pose k and where it is seen again."""
    return between(k, 2 * length + 1 - k, [0.0, 0.0, math.pi])


def ids(*numbers: int) -> np.ndarray:
    return np.array(numbers, np.int64)


@st.composite
def happenings(draw: st.DrawFn) -> list[tuple[str, int, float]]:
    kinds = st.sampled_from(["right", "right", "false", "false", "accept", "reject", "remove", "drop", "keep", "kill"])
    return draw(st.lists(st.tuples(kinds, st.integers(0, 30), st.floats(-3.0, 3.0)), min_size=3, max_size=14))


def new_solver(policy: str = "test") -> MapSolver:
    return make_map_solver("bayes-tree", {"closures": policy}, 5, Limits())


class TestedMap:
    """One map and its journal.  ids: of every factor that was accepted, the keys of its message."""

    __test__ = False

    def __init__(self, policy: str = "test") -> None:
        self.policy = policy
        self.solver, self.records, self.last = new_solver(policy), list[JournalRecord](), Last(0, 0, chain.START)
        self.ids: dict[int, tuple[int, ...]] = {}
        self._number = 0

    def insert(self, *contents: Batch, changes: tuple[Change, ...] = ()) -> list[Any]:
        """Into one record; the answers: of those that were refused the problem."""
        inserts = [self.arrived(content, changes) for content in contents]
        events, _ = self.solver.apply_whole(inserts)
        record = written(self.last.record + 1, inserts, events, self.last)
        self.records.append(record)
        self.last = Last(record.number, record.revision, record.chain)
        came = {id(outcome.insert): outcome for event in events for outcome in outcomes(event)}
        answers = [came[id(insert)] for insert in inserts]
        for content, outcome in zip(contents, answers, strict=True):
            rows = [tuple(row) for group in content.factors for row in group.keys.tolist()]
            if outcome.first_factor >= 0:
                self.ids |= {outcome.first_factor + k: row for k, row in enumerate(rows)}
        return [codec.decode_accepted(o.answer) if isinstance(o.answer, bytes) else o.answer for o in answers]

    def change(self, *changes: Change) -> Any:
        return self.insert(Batch(), changes=changes)[0]

    def suspects(self) -> Suspects:
        return decode_suspects(self.solver.suspects(True))

    def states(self) -> dict[int, str]:
        found = self.suspects()
        return dict(zip(found.factors.tolist(), found.states, strict=True))

    def in_graph(self) -> dict[int, tuple[int, ...]]:
        """Ids and keys of the factors of the estimate."""
        groups = self.solver.solver.graph()[1]
        return {
            i: tuple(row)
            for group in groups
            for i, row in zip(group.ids.tolist(), group.keys.tolist(), strict=True)
        }  # fmt: skip

    def kill(self, state: dict[str, Any] | None = None, since: int = 0) -> None:
        """Go on from what the journal has; state: a checkpoint after `since` records."""
        before, held = self.solver.suspects(True), self.content()
        self.solver = new_solver(self.policy)
        self.solver.load(state)
        present = self.records[since - 1].chain if since else chain.START
        for record in self.records[since:]:
            for event in self.solver.apply_again([arrived_again(entry) for entry in record.entries]):
                present = chain.extend_chain(present, event.delta) if isinstance(event, Stepped) else present
            assert present == record.chain, f"record {record.number} has other bits"
            assert self.solver.revision == record.revision
        assert self.content() == held
        assert self.solver.suspects(True) == before

    def go_back(self) -> None:
        """Apply all records anew without the verdicts, as where a replica puts its own behind others'."""
        own, self.records, self.last = self.records, [], Last(0, 0, chain.START)
        self.solver = new_solver(self.policy)
        for record in own:
            inserts = [arrived_again(entry) for entry in record.entries if entry.client != JUDGE]
            made = written(self.last.record + 1, inserts, list(self.solver.apply_again(inserts)), self.last)
            self.records.append(made)
            self.last = Last(made.number, made.revision, made.chain)

    def content(self) -> list[bytes]:
        """Every number of the estimate and of its factors, with their ids."""
        variables, factors = self.solver.solver.graph()
        columns = [(group.keys, group.values) for group in variables]
        columns += [(group.ids, group.measured, group.information) for group in factors]
        return [column.tobytes() for group in columns for column in group]

    def check_counts(self) -> None:
        states = list(self.states().values())
        assert self.suspects().counts == {state: states.count(state) for state in CLOSURE_STATES}

    def judged(self) -> int:
        """Entries of the judge."""
        return sum(entry.client == JUDGE for record in self.records for entry in record.entries)

    def arrived(self, content: Batch, changes: tuple[Change, ...] = ()) -> Arrived:
        self._number += 1
        message = codec.encode_insert(Insert(self._number, content, changes=changes))
        arrived = read_insert(None, "robot", message, Limits().message(), 0.0)
        assert not isinstance(arrived, Refuse)
        return arrived


def outcomes(event: object) -> tuple[Outcome, ...]:
    return event.outcomes if isinstance(event, Verdict) else ()
