"""A journal that another build of the solver wrote: opened from its checkpoint, and what differs is said."""

import json
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naive.solver_parts import graph_in

from factorbus.journal.checkpoints import file_of
from factorbus.journal.problems import JournalDiffers, JournalFailed
from factorbus.journal.records import Maker
from factorbus.journal.store import NAME
from factorbus.proto import codec
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Batch, Insert
from factorbus.service.config import Config, Limits
from factorbus.service.core.events import Arrived
from factorbus.service.core.map_state import MapCore
from factorbus.service.journal.keeping import Events
from factorbus.service.journal.library import CopiedAt, Kept, Library, open_library
from factorbus.service.journal.recovery import verify
from factorbus.service.questions.admin import MadeAs
from factorbus.service.questions.answers import Question
from factorbus.service.solving import apply
from factorbus.service.solving.arrival import read_insert
from factorbus.simulate import manhattan
from factorbus.solver import Solver
from factorbus.solver.build import present_build
from factorbus.solver.errors import Diverged
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.modes import MODE_OF_NAME
from factorbus.solver.state import FORMAT

INSERTS, CHECKPOINT = 12, 8
BATCHES = [step.batch for step in manhattan(INSERTS + 8, 2)]


class Untold:
    """Who is told what becomes of the writing: nobody."""

    def kept(self, events: Events) -> None: ...

    def unkept(self, problem: JournalFailed) -> None:
        raise problem

    blocked = unkept

    def unblocked(self) -> None: ...


class Session:
    """A map open, and at work without a bus."""

    def __init__(self, kept: Kept) -> None:
        self.kept, self.map_solver, self.recovered = kept, kept.map_solver, kept.recovered
        self.keeper = kept.keeper(Untold())
        assert self.keeper.start() is None

    def insert(self, *batches: Batch) -> None:
        for batch in batches:
            number = self.keeper.records + 1
            made = read_insert(None, "a", codec.encode_insert(Insert(number, batch)), REQUEST_LIMITS, 0.0)
            assert isinstance(made, Arrived)
            inserts = [made._replace(askers=[])]
            events, _ = self.map_solver.apply_whole(inserts)
            self.keeper.hand(inserts, events)

    def row(self) -> dict[str, Any]:
        """What admin/maps says."""
        core = MapCore("m", self.kept.header.mode, self.kept.header.epoch, Limits(), 0.0)
        self.kept.restore(core)
        return core.row()

    def values(self) -> dict[int, bytes]:
        taken = self.map_solver.snapshot([Question("estimate")])
        return {int(key): row.tobytes() for g in taken.variables for key, row in zip(g.keys, g.values, strict=True)}

    def makers(self) -> list[Maker]:
        return self.kept.store.makers()

    def close(self, checkpoint: bool = False) -> None:
        self.keeper.close(self.map_solver.dump if checkpoint else None)


@pytest.fixture
def library(tmp_path: Path) -> Iterator[Library]:
    tmp_path.chmod(0o700)
    found = open_library(Config(journal=str(tmp_path), durability="group", group_s=1e-3), lambda _: None, None)
    assert found is not None
    yield found
    found.close()


@pytest.fixture
def reopen(library: Library) -> Callable[[], Session]:
    return lambda: Session(library.open("m", Limits()))


@pytest.fixture(params=["bayes-tree", "inc-l"])
def values(library: Library, request: pytest.FixtureRequest) -> dict[int, bytes]:
    """A map with twelve inserts and a checkpoint after the eighth, closed; what its values were."""
    session = Session(library.make("m", MadeAs(request.param), Limits()))
    session.insert(*BATCHES[:CHECKPOINT])
    session.keeper.checkpoint(session.map_solver.dump(), 0.0)
    session.insert(*BATCHES[CHECKPOINT:INSERTS])
    found = session.values()
    session.close()
    return found


def changed(folder: Path, *statements: str) -> None:
    database = sqlite3.connect(folder / NAME, isolation_level=None)
    for statement in statements:
        database.execute(statement)
    database.close()


def by_another(folder: Path, **parts: str) -> None:
    """As if a build that differs in these parts had written it."""
    other = json.dumps({**present_build(), **parts})
    changed(folder, f"UPDATE checkpoint SET build = '{other}'", f"UPDATE maker SET build = '{other}'")


def rounding_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last number of every step is rounded as another processor might."""
    true_step = Solver.step

    def step(solver: Solver, settle: bool = False, budget: float | None = None) -> Any:
        report = true_step(solver, settle, budget)
        last = int(graph_in(solver).counts[at.VALUES]) - 1
        graph_in(solver).values[last] = np.nextafter(graph_in(solver).values[last], 9.0)
        return report

    monkeypatch.setattr(Solver, "step", step)


@pytest.mark.parametrize("part", ["sources", "processor", "versions", "flags"])
def test_another_build_goes_on_from_the_checkpoint_and_says_so(
    values: dict[int, bytes], reopen: Callable[[], Session], tmp_path: Path, part: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Upgraded, or moved to another machine; here all bits are the same, and that has been seen."""
    by_another(tmp_path / "m", **{part: "elsewhere"})
    session = reopen()
    assert (session.recovered.from_record, session.recovered.records) == (CHECKPOINT, INSERTS - CHECKPOINT)
    assert session.recovered.same
    assert session.recovered.other_build.startswith(f"{part} elsewhere, here ")
    assert f"map m was made by another build of the solver: {part} elsewhere" in caplog.text
    assert session.values() == values
    assert session.row()["reproducible"] is True
    session.insert(*BATCHES[INSERTS:])
    session.close()
    again = reopen()
    assert [(maker.record, maker.build[part] == "elsewhere") for maker in again.makers()] == [
        (1, True),
        (INSERTS + 1, False),
    ]
    again.close()


def test_where_no_fold_can_be_compared_that_is_said_and_stays_known(
    values: dict[int, bytes], reopen: Callable[[], Session], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    session = reopen()
    session.insert(BATCHES[INSERTS])
    session.keeper.checkpoint(session.map_solver.dump(), 0.0)
    session.close()
    by_another(tmp_path / "m", processor="elsewhere")
    session = reopen()
    assert (session.recovered.from_record, session.recovered.records) == (INSERTS + 1, 0)
    assert session.recovered.same, "no value has changed"
    row = session.row()
    assert row["reproducible"] is False
    assert row["reason"].startswith(f"another build wrote the checkpoint of record {INSERTS + 1} (processor elsewhere")
    assert f"map m is not reproducible: {row['reason']}" in caplog.text
    assert session.kept.header.epochs[1:] == ()
    session.close()
    session = reopen()
    assert len(session.makers()) == 1, "who made no record is not among the makers"
    session.insert(BATCHES[INSERTS + 1])
    session.close()
    session = reopen()
    assert session.row()["reason"] == row["reason"], "a record that this build made itself compares nothing"
    session.keeper.checkpoint(session.map_solver.dump(), 0.0)
    session.close()
    session = reopen()
    assert session.recovered.other_build == ""
    assert session.row()["reason"] == row["reason"], "what is before the checkpoint is still by another one"
    session.close()


def test_other_bits_after_the_checkpoint_are_said_and_begin_an_epoch(
    values: dict[int, bytes], reopen: Callable[[], Session], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_another(tmp_path / "m", processor="elsewhere")
    rounding_otherwise(monkeypatch)
    session = reopen()
    assert (session.recovered.from_record, session.recovered.same) == (CHECKPOINT, False)
    assert session.values() != values
    assert session.values().keys() == values.keys()
    row = session.row()
    assert row["reproducible"] is False
    assert row["reason"].startswith(
        f"from revision {CHECKPOINT + 1} on, values have other bits than they had: another build made them (processor "
    )
    assert len(session.kept.header.epochs) == 2
    assert "other bits" in session.kept.header.epochs[-1].because
    assert session.keeper.wants_checkpoint(), "another restart would not lead to these bits by another build"
    session.keeper.checkpoint(session.map_solver.dump(), 0.0)
    session.insert(BATCHES[INSERTS])
    present = session.values()
    session.close()
    session = reopen()
    assert (session.recovered.from_record, session.recovered.records) == (INSERTS, 1)
    assert session.recovered.same, "digests go on from what the journal had"
    assert session.values() == present
    assert len(session.kept.header.epochs) == 2, "and no further epoch"
    assert session.row()["reason"] == row["reason"]
    session.close()


def test_the_same_build_with_other_bits_says_that(
    values: dict[int, bytes], reopen: Callable[[], Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    rounding_otherwise(monkeypatch)
    session = reopen()
    assert session.row()["reason"].endswith("the same build made them")
    session.close()


def test_a_fold_with_other_bits_does_not_hide_those_after_it(
    values: dict[int, bytes], library: Library, tmp_path: Path
) -> None:
    """Each is compared from what the journal has of the one before."""
    changed(tmp_path / "m", "UPDATE record SET chain = x'00112233445566778899aabbccddeeff' WHERE number = 9")
    kept = library.open("m", Limits())
    same = {record.number: alike for record, alike in verify(kept.store, kept.map_solver)}
    kept.store.close()
    assert [number for number, alike in same.items() if not alike] == [9, 10], "10 begins with the digest of 9"


def test_a_checkpoint_in_another_format_is_not_read_and_all_is_folded_again(
    values: dict[int, bytes], reopen: Callable[[], Session], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    changed(tmp_path / "m", f"UPDATE checkpoint SET format = {FORMAT + 1}")
    session = reopen()
    assert (session.recovered.from_record, session.recovered.records, session.recovered.same) == (0, INSERTS, True)
    assert f"has a state of format {FORMAT + 1}, this version reads {FORMAT}: not used" in caplog.text
    assert session.values() == values
    assert session.row()["reproducible"] is True
    session.close()


def test_a_long_replay_is_made_once(
    values: dict[int, bytes], tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """It counts as steps do: the state is written when the service stops, if nothing came, or soon after an insert."""
    changed(tmp_path / "m", f"UPDATE checkpoint SET format = {FORMAT + 1}")
    often_folder = tmp_path_factory.mktemp("often")
    shutil.copytree(tmp_path / "m", often_folder / "m")
    often = open_library(Config(journal=str(often_folder), checkpoint_s=1e-6), lambda _: None, None)
    assert often is not None
    session = Session(often.open("m", Limits()))
    assert session.recovered.from_record == 0
    assert session.keeper.wants_checkpoint()
    session.close(checkpoint=True)
    session = Session(often.open("m", Limits()))
    assert (session.recovered.from_record, session.recovered.records) == (INSERTS, 0)
    session.close()
    often.close()


@pytest.mark.parametrize("processor", ["", "elsewhere"])
def test_a_damaged_checkpoint_is_not_read_whichever_build_wrote_it(
    values: dict[int, bytes], reopen: Callable[[], Session], tmp_path: Path, processor: str
) -> None:
    if processor:
        by_another(tmp_path / "m", processor=processor)
    path = file_of(tmp_path / "m", CHECKPOINT)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    session = reopen()
    assert (session.recovered.from_record, session.recovered.records, session.recovered.same) == (0, INSERTS, True)
    assert session.values() == values
    assert session.row()["reproducible"] is True, "all of it was compared"
    session.close()


def test_vectors_of_another_width_leave_the_estimate_and_r_is_computed_anew(
    values: dict[int, bytes], reopen: Callable[[], Session], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of R as they were would be read past their ends."""
    by_another(tmp_path / "m", processor="elsewhere")
    true_load = Solver.load
    monkeypatch.setattr(Solver, "load", lambda solver, state: true_load(solver, {**state, "lanes": 0}))
    session = reopen()
    assert (session.recovered.from_record, session.recovered.records) == (CHECKPOINT, INSERTS - CHECKPOINT)
    assert session.row()["reason"].startswith(
        f"R was computed anew: checkpoint {CHECKPOINT} has it for vectors of another width"
    )
    assert len(session.kept.header.epochs) == 2
    assert session.map_solver.revision == INSERTS
    for key, row in session.values().items():
        assert np.frombuffer(row) == pytest.approx(np.frombuffer(values[key]), abs=1e-3)
    session.insert(*BATCHES[INSERTS:])
    session.close(checkpoint=True)
    monkeypatch.undo()
    session = reopen()
    assert (session.recovered.from_record, session.recovered.same) == (len(BATCHES), True)
    session.close()


def test_a_step_more_or_less_by_another_build_keeps_no_map_closed(
    values: dict[int, bytes], reopen: Callable[[], Session], tmp_path: Path
) -> None:
    """A threshold may be crossed by one and not by the other; by the same build it is a fault."""
    changed(tmp_path / "m", "UPDATE record SET revision = revision + 1 WHERE number >= 10")
    with pytest.raises(JournalDiffers, match="record 10 led to revision 11, and leads to 10"):
        reopen()
    by_another(tmp_path / "m", processor="elsewhere")
    session = reopen()
    assert (session.recovered.from_record, session.recovered.same) == (CHECKPOINT, False)
    assert session.map_solver.revision == INSERTS + 1
    session.close()
    changed(tmp_path / "m", "DELETE FROM entry WHERE record = 11")
    with pytest.raises(JournalDiffers, match="record 11 led to revision 12, and leads to 11"):
        reopen()


def test_what_another_build_refused_as_diverged_stays_refused(
    values: dict[int, bytes], reopen: Callable[[], Session], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This build may take it: the client was told that it did not go in."""
    session = reopen()
    monkeypatch.setattr(apply, "find_diverged", lambda *_: Diverged("se2 x1", "1e+13", 1e12))
    session.insert(BATCHES[INSERTS])
    monkeypatch.undo()
    before, revision = session.values(), session.map_solver.revision
    session.close()
    with pytest.raises(JournalDiffers, match="was refused, and is accepted"):
        reopen()
    by_another(tmp_path / "m", processor="elsewhere")
    session = reopen()
    assert session.values().keys() == before.keys() == values.keys()
    assert session.map_solver.revision == revision
    session.close()


def test_a_fork_has_what_is_known_of_the_original(
    values: dict[int, bytes], library: Library, reopen: Callable[[], Session], tmp_path: Path
) -> None:
    session = reopen()
    forked = Session(library.fork("m", "n", CopiedAt(INSERTS, session.map_solver.dump(), "it is so"), Limits()))
    assert forked.values() == values
    assert forked.row()["reason"] == "it is so"
    forked.insert(BATCHES[INSERTS])
    assert forked.kept.header.epochs[-1].record == INSERTS + 1
    forked.close()
    again = Session(library.open("n", Limits()))
    assert (again.recovered.from_record, again.row()["reason"]) == (INSERTS, "it is so")
    again.close()
    session.close()


@pytest.mark.parametrize("mode", MODE_OF_NAME)
def test_a_map_without_a_journal_says_nothing_of_it(mode: str) -> None:
    assert "reproducible" not in MapCore("m", mode, 1, Limits(), 0.0).row()
