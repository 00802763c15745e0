"""A map that takes out poses by its policy, with a journal: run again it has the same bits, from any checkpoint."""

from pathlib import Path

import numpy as np
import pytest
from tested_maps import between

from factorbus.journal.bundle import export_map, import_map
from factorbus.journal.problems import JournalOption
from factorbus.journal.store import Store, create, open_store
from factorbus.proto import codec
from factorbus.proto.closures import decode_suspects
from factorbus.proto.keep import keep_text
from factorbus.proto.messages import Batch, Change, Insert, Variables
from factorbus.proto.own_clients import KEEPER
from factorbus.service.config import Limits
from factorbus.service.core.events import Arrived, MovedClosure, Verdict
from factorbus.service.journal.library import made_as_of, make_map_solver
from factorbus.service.journal.recovery import recover, verify
from factorbus.service.journal.writing import written
from factorbus.service.solving.arrival import message_digest
from factorbus.simulate import manhattan
from factorbus.solver.closures.judging import COMPARED

EPOCH = 7
KEEP = keep_text("per_area=2,window=20")
BATCHES = [step.batch for step in manhattan(400, 3)]


class Kept:
    """A map with a journal, which keeps within its policy at intervals."""

    def __init__(self, folder: Path, closures: str = "trust") -> None:
        self.options = {"keep": KEEP, "closures": closures}
        self.map_solver = make_map_solver("bayes-tree", self.options, EPOCH, Limits())
        self.store: Store = create(folder, "m", "bayes-tree", self.map_solver.options(), EPOCH, "none")
        self.removed = self.plans = self.number = 0
        self.told: list[MovedClosure] = []  # by the last insert
        self.gone: list[int] = []  # closures that went with a pose that the policy took out

    def insert(self, batch: Batch, changes: tuple[Change, ...] = ()) -> None:
        self.number += 1
        content = Insert(self.number, batch, changes=changes)
        message = codec.encode_insert(content)
        self.apply(Arrived([], "a", self.number, 0, len(message), message_digest(message), content, 0.0, message))

    def apply(self, arrived: Arrived) -> None:
        events, _ = self.map_solver.apply_whole([arrived])
        self.told = [moved for event in events if isinstance(event, Verdict) for moved in event.closures]
        last = self.store.last()
        record = written(last.record + 1, [arrived], events, last)
        assert all(entry.outcome == 0 for entry in record.entries if entry.client == KEEPER)
        self.store.append([record])

    def keep(self) -> None:
        while True:
            planned, inserts = self.map_solver.plan_removals()
            if not planned.poses:
                return
            self.removed += planned.poses
            self.plans += 1
            self.apply(inserts[0])
            self.gone += [moved.factor for moved in self.told if (moved.state, moved.reason) == ("gone", "pose_gone")]


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Kept:
    made = Kept(tmp_path_factory.mktemp("keep") / "m")
    for n, batch in enumerate(BATCHES, 1):
        made.insert(as_the_map_has_it(made, batch))
        if n % 100 == 0:
            made.keep()
    assert made.plans > 3
    assert made.removed > 100
    return made


def as_the_map_has_it(made: Kept, batch: Batch) -> Batch:
    """Without closures to poses that went."""
    graph = made.map_solver._solver.factor_graph
    new = {int(key) for group in batch.variables for key in group.keys}
    groups = []
    for group in batch.factors:
        rows = [k for k, row in enumerate(group.keys.tolist()) if all(v in new or graph.find(v) >= 0 for v in row)]
        groups.append(group._replace(keys=group.keys[rows], measured=group.measured[rows],
                                     information=group.information[rows]))  # fmt: skip
    return batch._replace(factors=tuple(group for group in groups if len(group.keys)))


def test_it_is_as_large_as_the_policy_says(kept: Kept) -> None:
    variables, _ = kept.map_solver.size
    assert variables == len(BATCHES) - kept.removed
    assert kept.map_solver.plan_removals()[0].poses == 0


def test_run_again_it_has_the_same_bits(kept: Kept) -> None:
    assert all(same for _, same in verify(kept.store, make_map_solver("bayes-tree", kept.options, EPOCH, Limits())))
    one = make_map_solver("bayes-tree", kept.options, EPOCH, Limits())
    found = recover(kept.store, one)
    assert found.same
    assert one.size == kept.map_solver.size
    assert one.chi2() == kept.map_solver.chi2()


def test_its_own_inserts_are_counted_with_nobodys(kept: Kept) -> None:
    counts = kept.store.counts()
    assert counts["inserts"] == len(BATCHES)
    assert counts["clients"] == 1
    assert counts["records"] == len(BATCHES) + kept.plans


def test_a_copy_of_it_in_one_file_can_be_imported(kept: Kept, tmp_path: Path) -> None:
    export_map(kept.store.path.parent, tmp_path / "m.fbmap")
    import_map(tmp_path / "m.fbmap", tmp_path / "other" / "n")
    assert list(open_store(tmp_path / "other" / "n").records()) == list(kept.store.records())


def test_the_policy_is_in_the_journal(kept: Kept) -> None:
    assert made_as_of("bayes-tree", kept.map_solver.options()).keep == KEEP
    assert make_map_solver("bayes-tree", {}, EPOCH, Limits()).options().get("keep") is None
    with pytest.raises(JournalOption, match="per_area"):
        make_map_solver("bayes-tree", {"keep": "window=2"}, EPOCH, Limits())


def test_poses_of_a_closure_that_is_out_stay(tmp_path: Path) -> None:
    made = Kept(tmp_path / "m", "test")
    made.insert(Batch((Variables("se2", np.array([0]), np.zeros((1, 3)), True),)))
    for k in range(1, 60):
        made.insert(Batch((Variables("se2", np.array([k])),), (between(k - 1, k, [1.0, 0.0, 0.0]),)))
    made.insert(Batch((), (between(10, 31, [0.0, 3.0, 0.5]),)))
    (out,) = decode_suspects(made.map_solver.suspects(False)).keys.tolist()
    assert out == [10, 31]
    made.keep()
    assert made.removed > 10
    graph = made.map_solver._solver.factor_graph
    assert graph.find(10) >= 0 <= graph.find(31)
    assert decode_suspects(made.map_solver.suspects(False)).keys.tolist() == [[10, 31]]


def test_poses_of_closures_that_no_new_one_is_compared_with_and_of_rejected_ones_go(tmp_path: Path) -> None:
    """A robot that closes false loops for years would have all their poses."""
    made = Kept(tmp_path / "m", "test")
    made.insert(Batch((Variables("se2", np.array([0]), np.zeros((1, 3)), True),)))
    count = COMPARED + 40
    for k in range(1, 2 * count + 40):
        made.insert(Batch((Variables("se2", np.array([k])),), (between(k - 1, k, [0.2, 0.0, 0.0]),)))
    for k in range(count):
        made.insert(Batch((), (between(2 * k, 2 * k + 7, [0.0, 3.0 + k % 7, 0.5]),)))
    closures = decode_suspects(made.map_solver.suspects(False))
    assert len(closures.factors) == count
    made.insert(Batch(), (Change("reject", closures.factors[-3:]),))
    made.keep()
    graph = made.map_solver._solver.factor_graph
    left = decode_suspects(made.map_solver.suspects(False)).keys.tolist()
    suspects = [pair for pair in closures.keys.tolist()[:-3] if min(graph.find(key) for key in pair) >= 0]
    assert [pair for pair in left if pair in suspects] == suspects
    assert COMPARED <= len(suspects) < COMPARED + 5
    assert len(left) < count - 30
    after = decode_suspects(made.map_solver.suspects(True)).factors
    assert sorted(made.gone) == np.setdiff1d(closures.factors, after).tolist(), "each has one event"
