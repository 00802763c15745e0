"""What may be asked of a map, and the answers, made from copies of one revision.

The copies are made on the solver's thread between two steps: making and sending the answer is
somebody else's time, and no reader sees half a step or holds one up.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from factorbus.proto import codec, fields
from factorbus.proto.arrays import I64
from factorbus.proto.asking import AskRepair, Repaired
from factorbus.proto.closures import decode_ask_suspects
from factorbus.proto.components import encode_components
from factorbus.proto.interest import InterestFilter
from factorbus.proto.interest_codec import decode_ask_interest, read_filter
from factorbus.proto.keys import QUESTIONS
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Batch, Chi2, Estimate, Factors, MapGraph, Variables
from factorbus.proto.problems import BadOption, Problem, UnknownQuestion, without_frames
from factorbus.proto.repair_codec import decode_ask_repair, encode_repaired
from factorbus.proto.stamps import NO_STAMP
from factorbus.service.questions.components import components_of_map
from factorbus.service.questions.question_memory import COPIES, Room
from factorbus.service.questions.uncertainty import DECODE, MissingVariables, Uncertain, check_keys, near_variables
from factorbus.solver.changes.repair import repair
from factorbus.solver.errors import SolverError

if TYPE_CHECKING:
    from factorbus.formats import FileNotes

_GRAPHS, _TRAJECTORIES = ("g2o", "pyfg", "jrl"), ("tum", "kitti")
_IDS = ("auto", "ids", "keys", "counted")
_WAIT_S = (0.001, 86_400.0)
# How many times the bytes of the solver it takes to repair a map, and to factorize one in a mode that keeps no R.
_REPAIR, _FRESH = 4, 3
_UNBOUNDED = Room()


@dataclass(frozen=True, slots=True)
class Question:
    """One question, checked.  keys, part: of an estimate, None for all.  batch, values, timeout_s: of chi2.
    format, robot, strict, ids: of export.  ask: of one about uncertainty, of an interest, and of a copy (which only the
    service itself asks for), all of it.
    """

    name: str
    keys: I64 | None = None
    batch: bool = False
    values: bool = False
    timeout_s: float = 60.0
    format: str = "g2o"
    robot: str | None = None
    strict: bool = False
    ids: str = "auto"
    part: InterestFilter | None = None
    ask: Any = None


@dataclass(frozen=True, slots=True)
class Copied:
    """The whole state of a map's solver, for another one to go on from.  state: None if there was no room for it."""

    state: Mapping[str, Any] | None
    bytes: int


@dataclass(frozen=True, slots=True)
class QuestionCopies:
    """Copies of what some questions need, all of one revision.

    uncertain: R, if it was copied.  ready: answers, or why there is none, by the identity of the question.  content: a
    solver's copy of everything.  copied: the map solver's, and after which record of the journal that was.  room: for
    what is made of it.
    """

    epoch: int
    revision: int
    variables: tuple[Variables, ...] = ()
    factors: tuple[Factors, ...] = ()
    chi2: float = 0.0
    uncertain: Uncertain | None = None
    ready: Mapping[int, bytes | Exception] = field(default_factory=dict)
    content: Any = None
    copied: Copied | None = None
    record: int = 0
    room: Room = _UNBOUNDED

    @property
    def graph(self) -> MapGraph:
        """The whole map, if it was copied for a question that needs it."""
        return MapGraph(self.epoch, self.revision, Batch(self.variables, self.factors))


def parse(name: str, payload: bytes) -> Question:
    """The question `name` with the parameters in `payload`.  Raises UnknownQuestion, BadMessage, TooLarge."""
    if name == "estimate":
        return _estimate(payload)
    if name not in QUESTIONS:
        raise UnknownQuestion(name, f"one of {', '.join(QUESTIONS)}")
    if name in DECODE:
        return Question(name, ask=DECODE[name](payload))
    if name == "repair":
        return Question(name, ask=decode_ask_repair(payload))
    if name == "suspects":
        return Question(name, ask=decode_ask_suspects(payload))
    if name == "interest":
        return Question(name, ask=decode_ask_interest(payload))
    content = codec.decode_map(payload, REQUEST_LIMITS, what="question")
    if name == "chi2":
        timeout_s = fields.parameter("question", content, "timeout_s", _WAIT_S, "from 0.001 to 86400 seconds", 60.0)
        batch, values = fields.flag("question", content, "batch"), fields.flag("question", content, "values")
        return Question(name, batch=batch, values=values, timeout_s=timeout_s)
    return _export(content) if name == "export" else Question(name)


def _estimate(payload: bytes) -> Question:
    """The question for values.  Raises BadMessage, BadOption."""
    keys, part = codec.decode_keys_asked(payload), None
    if payload:
        content = codec.decode_map(payload, REQUEST_LIMITS, what="question")
        part = read_filter(content)
    if keys is not None and part is not None:
        raise BadOption("question.keys", "given with a filter", "either of the two")
    return Question("estimate", keys=keys, part=part)


def _export(content: dict[str, Any]) -> Question:
    """The question for a file.  Raises BadMessage, BadOption."""
    format = fields.choice_of("question", content, "format", (*_GRAPHS, *_TRAJECTORIES), "g2o")
    ids = fields.choice_of("question", content, "ids", _IDS, "auto")
    robot = fields.text("question", content, "robot", "") if content.get("robot") is not None else None
    if robot is not None and (len(robot) > 1 or (robot and not (robot.isascii() and robot.isalpha()))):
        raise BadOption("question.robot", f"is {robot[:40]!r}", "one ASCII letter, or an empty string")
    if robot is not None and format in _GRAPHS:
        raise BadOption("question.robot", f"is {robot!r}", f"none with {format}, which has the whole map")
    strict = fields.flag("question", content, "strict")
    if format in _GRAPHS and format != "g2o" and ids != "auto":
        raise BadOption("question.ids", f"is {ids!r}", f"none with {format}, which has the keys themselves")
    if format in _TRAJECTORIES and (strict or ids != "auto"):
        where, seen = ("strict", "is true") if strict else ("ids", f"is {ids!r}")
        raise BadOption(f"question.{where}", seen, f"none with {format}, which is a trajectory alone")
    return Question("export", format=format, robot=robot, strict=strict, ids=ids)


def snapshot(
    solver: Any,
    epoch: int,
    revision: int,
    questions: Sequence[Question],
    reported: Mapping[str, Any],
    uncertain: Uncertain | None = None,
    room: Room = _UNBOUNDED,
) -> QuestionCopies:
    """What `questions` need of `solver`, copied.  reported: of its last step.  uncertain: R, if it is copied already.

    room: what has no room is refused by itself.
    """
    ready = _refused(solver, questions, uncertain is not None, room)
    questions = [question for question in questions if id(question) not in ready]
    names = {question.name for question in questions}
    whole = bool(names & {"graph", "export", "components"}) or any(q.batch for q in questions)
    variables, factors = solver.graph() if whole else ((), ())
    if not whole and names & {"estimate", "snapshot", "interest"}:
        variables = solver.estimate()
    chi2 = solver.chi2() if "chi2" in names else 0.0
    asked = [question for question in questions if question.name in DECODE]
    view = solver.covariances.try_view() if any(near_variables(question.ask) for question in asked) else None
    near = [question for question in asked if view is not None and near_variables(question.ask)]
    if view is not None:
        here = Uncertain(lambda: view, epoch, revision, True, reported, room)
        ready |= {id(question): _answer_or_problem(here, question) for question in near}
    if uncertain is None and len(near) < len(asked):
        keeps_steps = view is not None or solver.covariances.try_view() is not None
        uncertain = Uncertain(solver.covariances.factoring(), epoch, revision, keeps_steps, reported, room)
    content = solver.content() if "repair" in names else None
    groups = as_variables(variables), as_factors(factors)
    return QuestionCopies(epoch, revision, *groups, chi2, uncertain, ready, content, room=room)


def _refused(solver: Any, questions: Sequence[Question], has_copy: bool, room: Room) -> dict[int, bytes | Exception]:
    """Why there is no answer, by the identity of the question, of those that there is no room for."""
    refused: dict[int, bytes | Exception] = {}
    for question in questions:
        try:
            _check(solver, question, has_copy, room)
        except Problem as problem:
            refused[id(question)] = problem
    return refused


def _check(solver: Any, question: Question, has_copy: bool, room: Room) -> None:
    """Is there room for what `question` needs copied, and for its answer?  Raises TooLarge, OutOfMemory."""
    name = question.name
    if name in ("estimate", "graph", "export", "interest", "components") or question.batch:
        variables, factors = solver.factor_graph.columns_bytes()
        size = variables if name in ("estimate", "interest") else variables + factors
        if name == "graph" or (name == "estimate" and question.keys is None and question.part is None):
            room.fits("the answer", size)
        room.check(COPIES * size)
    elif name == "repair":
        room.check(_REPAIR * solver.memory_bytes())
    elif name in DECODE:
        check_keys(question.ask, room)
        if not has_copy and not (near_variables(question.ask) and solver.covariances.try_view() is not None):
            room.check((1 if solver.covariances.try_view() is not None else _FRESH) * solver.memory_bytes())


def as_variables(groups: Iterable[Any]) -> tuple[Variables, ...]:
    """The solver's groups as what the codec takes."""
    return tuple(Variables(g.kind, g.keys, g.values, g.fixed, g.stamps) for g in groups)


def as_factors(groups: Iterable[Any]) -> tuple[Factors, ...]:
    """The solver's factor groups as what the codec takes."""
    return tuple(Factors(g.kind, g.keys, g.measured, g.information, g.loss, g.scale, g.ids) for g in groups)


def answer(question: Question, taken: QuestionCopies) -> bytes:
    """The answer to any question but stats and chi2 against batch.  Raises Problem, SolverError."""
    message = _answer(question, taken)
    if question.name != "snapshot":
        taken.room.fits("the answer", len(message))
    return message


def is_computed(question: Question, taken: QuestionCopies) -> bool:
    """Whether there is more to do for the answer than to put together what `taken` has."""
    return id(question) not in taken.ready and (
        question.name in DECODE or question.name in ("repair", "export", "components")
    )


def check_ready(question: Question, taken: QuestionCopies) -> None:
    """Raises what `question` was refused with when copies were made."""
    if isinstance(ready := taken.ready.get(id(question)), Exception):
        raise ready


def _answer(question: Question, taken: QuestionCopies) -> bytes:
    check_ready(question, taken)
    if question.name == "repair":
        return _repaired(taken, question.ask)
    if question.ask is not None:
        ready = taken.ready.get(id(question))
        return ready if isinstance(ready, bytes) else _uncertain(taken).answer(question.ask)
    if question.name in ("estimate", "snapshot"):
        chosen = taken.variables if question.keys is None else _chosen(taken.variables, question.keys)
        chosen = chosen if question.part is None else question.part.pick(chosen)
        return codec.encode_estimate(Estimate(taken.epoch, taken.revision, chosen))
    if question.name == "chi2":
        return codec.encode_chi2(Chi2(taken.epoch, taken.revision, taken.chi2))
    if question.name == "graph":
        return codec.encode_graph(taken.graph)
    if question.name == "components":
        return encode_components(components_of_map(taken.graph))
    text, notes = _text(question, taken.graph.batch)
    told = {"epoch": taken.epoch, "revision": taken.revision, "format": question.format}
    return codec.encode_map({**told, "text": text, "notes": list(notes), "left_out": notes.counts})


def _repaired(taken: QuestionCopies, ask: AskRepair) -> bytes:
    """On the thread that answers, which may take seconds: nobody else waits for it."""
    started = time.perf_counter()
    found = repair(taken.content, ask.factors, ask.probability)
    variables = as_variables(found.groups) if ask.values else ()
    return encode_repaired(
        Repaired(
            taken.epoch,
            taken.revision,
            found.false,
            found.distance,
            found.suspects,
            found.before,
            found.after,
            found.chi2_left,
            time.perf_counter() - started,
            variables,
        )
    )


def _answer_or_problem(uncertain: Uncertain, question: Question) -> bytes | Exception:
    try:
        return uncertain.answer(question.ask)
    except (Problem, SolverError) as problem:
        return without_frames(problem)


def _uncertain(taken: QuestionCopies) -> Uncertain:
    if taken.uncertain is None:
        raise ValueError("nothing was copied for this question")
    return taken.uncertain


def _chosen(groups: Iterable[Variables], keys: I64) -> tuple[Variables, ...]:
    missing = np.unique(keys)
    chosen: list[Variables] = []
    for group in groups:
        rows = np.isin(group.keys, keys)
        if rows.any() and group.values is not None:
            stamps = None if group.stamps is None else group.stamps[rows]
            told = stamps is not None and (stamps != NO_STAMP).any()
            columns = group.keys[rows], group.values[rows]
            chosen.append(Variables(group.kind, *columns, group.fixed, stamps if told else None))
            missing = np.setdiff1d(missing, group.keys[rows])
    if missing.size:
        raise MissingVariables(missing)
    return tuple(chosen)


def _text(question: Question, batch: Batch) -> tuple[str, "FileNotes"]:
    """(the file, what was left out of it).  Raises FormatError, SeveralRobots."""
    # Only who asks for an export pays for it.
    from factorbus.formats import FileNotes, as_g2o, as_jrl, as_pyfg, kitti_text, tum_notes, tum_text

    if question.format in _GRAPHS:
        strict = question.strict
        if question.format == "g2o":
            written = as_g2o(batch, strict, question.ids)
        else:
            written = {"pyfg": as_pyfg, "jrl": as_jrl}[question.format](batch, strict)
        return written.text, written.notes
    if question.format == "tum":
        return tum_text(batch, question.robot), tum_notes(batch, question.robot)
    return kitti_text(batch, question.robot), FileNotes()
