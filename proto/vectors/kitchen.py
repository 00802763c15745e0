"""The map that the golden messages of `make.py` are of, and what the solver answers about it.

Stated: `insert` (x0 fixed, x1, odometry), `insert_without_values` (x2, odometry) and `insert_loop` (two landmarks, a
loop closure that is a little off, one that is far off and has a loss) lead to revisions 1, 2 and 3, in the mode
`all-batch`; `graph_worse` and `insert_stamps` are maps of their own.
Every answer is of one of these revisions, computed by the solver and rounded to nine significant digits, so that all
machines write the same bytes; what is below 1e-12 is written as 0.  `tests/proto/test_answers.py` computes them again
with dense matrices.  Seconds and milliseconds are made up.
"""

from dataclasses import replace
from typing import Any

import msgpack
import numpy as np

from factorbus.proto import asking, codec
from factorbus.proto import asking_codec as asked
from factorbus.proto import repair_codec as repairs
from factorbus.proto.components import encode_components
from factorbus.proto.messages import (
    Accepted,
    Batch,
    Change,
    Chi2,
    Delta,
    Estimate,
    Factors,
    Insert,
    Job,
    JobDone,
    MapGraph,
    Optimum,
    Variables,
)
from factorbus.proto.problems import BetterOptimum
from factorbus.proto.stamps import LEAST_STAMP, NO_STAMP
from factorbus.proto.step_history import StepHistory, encode_step_history
from factorbus.proto.symbols import symbol
from factorbus.service.questions.components import components_of_map
from factorbus.service.questions.uncertainty import Uncertain
from factorbus.solver import Options, Solver
from factorbus.solver.changes.repair import repair
from factorbus.workers import jobs

EPOCH = 7
X, L = [symbol("x", i) for i in range(4)], [symbol("l", i) for i in (1, 2)]
POSE, POINT = [100.0, 0, 0, 100, 0, 400], [64.0, 0.0, 64.0]
FALSE = 3  # the id of the closure that is far off
_DIGITS, _NOTHING, _MS, _SECONDS = 9, 1e-12, 1.5, 0.5
# Fields of a bin that hold doubles which the solver has computed.
_COMPUTED = ("chi2", "values", "covariance", "distance", "threshold", "gain", "distances")


def messages() -> dict[str, bytes]:
    """All of them, by name."""
    solver = Solver(Options(mode="all-batch"))
    steps, reports, changed = [], [], []
    for batch, settle in ((first(), False), (second(), False), (third(), True)):
        solver.stage(batch)
        steps.append(solver.step(settle))
        reports.append(_short(steps[-1]))
        changed.append(_variables(solver.changed()))
    variables, factors = solver.graph()
    graph = MapGraph(EPOCH, 3, Batch(_variables(variables), tuple(_factors(factors))))
    chi2, optimum = solver.chi2(), codec.decode_optimum(jobs.run_job("batch", codec.encode_graph(graph)))
    made = {
        "insert": codec.encode_insert(Insert(1, first(), epoch=EPOCH)),
        "insert_without_values": codec.encode_insert(Insert(2, second(), epoch=EPOCH)),
        "insert_loop": codec.encode_insert(Insert(3, third(), settle=True, epoch=EPOCH)),
        "accepted": codec.encode_accepted(Accepted(1, EPOCH, 1, 0, 1, reports[0])),
        "delta": codec.encode_delta(Delta(EPOCH, 3, 2, changed[2], reports[2])),
        "estimate": codec.encode_estimate(Estimate(EPOCH, 3, graph.batch.variables)),
        "graph": codec.encode_graph(graph),
        "graph_ids": codec.encode_graph(_without_the_false_one()),
        "components": encode_components(components_of_map(graph)),
        "history": _history(steps),
        "chi2": codec.encode_chi2(Chi2(EPOCH, 3, chi2)),
        "chi2_batch": codec.encode_chi2(Chi2(EPOCH, 3, chi2, optimum.chi2, "w1", _SECONDS)),
        "job": codec.encode_job(Job("j1", "batch", rounded(codec.encode_graph(graph)))),
        "job_done": _done(replace(optimum, start=""), "j1"),
        **_not_converged(graph, chi2),
        **_worse(),
        **_stamped_answers(),
        **_about_uncertainty(solver, reports[2]),
    }
    return {name: data if name.startswith(("insert", "ask")) else rounded(data) for name, data in made.items()}


def _history(reports: list[Any]) -> bytes:
    """The three steps."""
    chi2, eliminated, changed = (
        np.array([getattr(report, name) for report in reports]) for name in ("chi2", "eliminated", "changed")
    )
    return encode_step_history(StepHistory(EPOCH, 3, np.arange(1, 4), chi2, np.full(3, _MS), eliminated, changed))


def first() -> Batch:
    """x0, fixed at the origin, x1 and the odometry between them."""
    return Batch(
        (
            Variables("se2", np.array(X[:1]), np.zeros((1, 3)), fixed=True),
            Variables("se2", np.array(X[1:2]), np.array([[1.5, 0.25, 0.125]])),
        ),
        (odometry(0),),
    )


def second() -> Batch:
    """x2, which the service composes."""
    return Batch((Variables("se2", np.array(X[2:3])),), (odometry(1),))


def third() -> Batch:
    """Two landmarks, a closure of the loop, and a false one."""
    return Batch(
        (Variables("point2", np.array(L), np.array([[2.5, 1.5], [4.0, 0.5]])),),
        (
            Factors("between_se2", np.array([[X[0], X[2]]]), np.array([[2.875, 0.875, 0.3125]]), np.array([POSE])),
            Factors(
                "between_se2", np.array([[X[0], X[2]]]), np.array([[2.0, 2.0, 1.0]]), np.array([POSE]), "cauchy",
                np.array([1.5]),
            ),
            Factors(
                "landmark_se2",
                np.array([[X[1], L[0]], [X[2], L[0]], [X[2], L[1]]]),
                np.array([[1.125, 1.125], [-0.25, 0.75], [1.0, -0.75]]),
                np.array([POINT] * 3),
            ),
        ),
    )  # fmt: skip


def odometry(number: int) -> Factors:
    """From one pose to the next."""
    return Factors("between_se2", np.array([X[number : number + 2]]), np.array([[1.5, 0.25, 0.125]]), np.array([POSE]))


def stamped() -> Batch:
    """A fixed pose at the time 0; two, of which one has a time and the other none; a point with the least there is."""
    rows = np.array([[1.5, 0.25, 0.125], [3.0, 0.75, 0.25]])
    return Batch(
        (
            Variables("se2", np.array(X[:1]), np.zeros((1, 3)), True, np.array([0])),
            Variables("se2", np.array(X[1:3]), rows, False, np.array([1_403_636_579_763_555_584, NO_STAMP])),
            Variables("point2", np.array(L[:1]), np.array([[3.0, 4.0]]), True, np.array([LEAST_STAMP])),
        ),
        (odometry(0), odometry(1)),
    )


def rounded(data: bytes) -> bytes:
    """The same message with what was computed in nine significant digits."""
    return msgpack.packb(_rounded(msgpack.unpackb(data))) or b""


def _rounded(content: Any, name: str = "") -> Any:
    if isinstance(content, dict):
        return {key: _rounded(each, key) for key, each in content.items()}
    if isinstance(content, list):
        return [_rounded(each, name) for each in content]
    if isinstance(content, float):
        return _digits(content)
    if isinstance(content, bytes) and name == "payload":
        return rounded(content)
    if isinstance(content, bytes) and name in _COMPUTED:
        return np.array([_digits(number) for number in np.frombuffer(content, "<f8").tolist()]).tobytes()
    return content


def _digits(number: float) -> float:
    return float(f"{number:.{_DIGITS}g}") if abs(number) > _NOTHING else 0.0


def _about_uncertainty(solver: Solver, report: dict[str, Any]) -> dict[str, bytes]:
    candidates = (
        Factors("between_se2", np.array([[X[1], X[2]], [X[0], X[1]]]), np.array([[1.5, 0.25, 0.25], [2.5, 0.0, 0.0]]),
                np.array([POSE] * 2)),
    )  # fmt: skip
    observations = np.array([[1.0, -0.625], [6.0, 6.0]])
    questions = {
        "covariances": ("ask_covariance", asking.AskCovariance()),
        "covariances_joint": ("ask_covariance_joint", asking.AskCovariance("joint", np.array([X[1], L[1]]))),
        "covariances_cross": (
            "ask_covariance_cross",
            asking.AskCovariance("cross", np.array(X[1:3]), np.array(L[:1])),
        ),
        "covariances_relative": (
            "ask_covariance_relative",
            asking.AskCovariance("relative", np.array([[X[1], X[2]], [X[2], L[1]]])),
        ),
        "gated": ("ask_gate", asking.AskGate(candidates, 0.99)),
        "gained": ("ask_gain", asking.AskGain(candidates)),
        "associated": (
            "ask_associate",
            asking.AskAssociate(X[2], "landmark_se2", observations, np.array([POINT] * 2), np.array(L), 0.95),
        ),
        "why": ("ask_why_factor", asking.AskWhy(factor=FALSE)),
        "why_variable": ("ask_why", asking.AskWhy(key=X[1])),
    }
    encode = {
        asking.AskCovariance: asked.encode_ask_covariance, asking.AskGate: asked.encode_ask_gate,
        asking.AskGain: asked.encode_ask_gain, asking.AskAssociate: asked.encode_ask_associate,
        asking.AskWhy: asked.encode_ask_why,
    }  # fmt: skip
    uncertain = Uncertain(solver.covariances.factoring(), EPOCH, 3, False, report)
    made = {name: uncertain.answer(ask) for name, (_, ask) in questions.items()}
    made |= {name: encode[type(ask)](ask) for name, ask in questions.values()}
    ask = asking.AskRepair(np.array([2, FALSE]), 0.95, values=True)
    found = repair(solver.content(), ask.factors, ask.probability)
    repaired = asking.Repaired(
        EPOCH, 3, found.false, found.distance, found.suspects, found.before, found.after,
        found.chi2_left, _SECONDS, _variables(found.groups),
    )  # fmt: skip
    return made | {"ask_repair": repairs.encode_ask_repair(ask), "repaired": repairs.encode_repaired(repaired)}


def _without_the_false_one() -> MapGraph:
    """Revision 4, after an insert that removes it: ids are no longer 0, 1, 2, ..."""
    solver = Solver(Options(mode="all-batch"))
    closing = third()
    kept = tuple(group for group in closing.factors if not group.loss)
    for batch in (first(), second(), closing._replace(factors=kept)):
        solver.stage(batch)
        solver.step(settle=True)
    variables, factors = solver.graph()
    ids = {"between_se2": [0, 1, 2], "landmark_se2": [4, 5, 6]}
    groups = tuple(group._replace(ids=np.array(ids[group.kind])) for group in _factors(factors))
    return MapGraph(EPOCH, 4, Batch(_variables(variables), groups))


def _not_converged(graph: MapGraph, chi2: float) -> dict[str, bytes]:
    """A worker that ended after one iteration from composed odometry."""
    solver = Solver(Options(mode="all-batch", max_iterations=1))
    bare = tuple(each if each.fixed else Variables(each.kind, each.keys) for each in graph.batch.variables)
    solver.stage(Batch(bare, graph.batch.factors))
    report = solver.step()
    groups, _ = solver.graph()
    optimum = Optimum(report.chi2, report.iterations, _variables(groups), "odometry", report.converged)
    told = Chi2(EPOCH, 3, chi2, optimum.chi2, "w1", _SECONDS, optimum.start, batch_converged=optimum.converged)
    return {"job_done_not_converged": _done(optimum, "j1"), "chi2_not_converged": codec.encode_chi2(told)}


def _worse() -> dict[str, bytes]:
    """Four poses in one place, which begin turned by a quarter each: a loop that is wound round once, and a minimum."""
    poses = np.array([[0.0, 0.0, np.pi / 2 * n] for n in range(4)])
    poses[3, 2] -= 2 * np.pi
    edges = np.array([[X[n], X[(n + 1) % 4]] for n in range(4)])
    turns = np.array([[0.0, 0.0, 0.0]] * 3 + [[0.0, 0.0, 0.5]])
    batch = Batch(
        (Variables("se2", np.array(X[:1]), poses[:1], fixed=True), Variables("se2", np.array(X[1:]), poses[1:])),
        (Factors("between_se2", edges, turns, np.array([[16.0, 0, 0, 16, 0, 16]] * 4)),),
    )
    solver = Solver(Options(mode="all-batch"))
    solver.stage(batch)
    solver.step(settle=True)
    variables, factors = solver.graph()
    graph = MapGraph(EPOCH, 1, Batch(_variables(variables), tuple(_factors(factors))))
    optimum = codec.decode_optimum(jobs.run_job("batch", codec.encode_graph(graph)))
    free = tuple(group for group in optimum.variables if not group.fixed)
    told = [_digits(number) for number in (solver.chi2(), optimum.chi2)]
    notice = BetterOptimum.or_none(told[0], told[1], optimum.start)
    place = Change("place", keys=free[0].keys, kind="se2", values=free[0].values, carry=True)
    return {
        "graph_worse": codec.encode_graph(graph),
        "chi2_better": codec.encode_chi2(
            Chi2(EPOCH, 1, told[0], told[1], "w1", _SECONDS, optimum.start, notice, optimum.variables)
        ),
        "job_done_start": _done(optimum, "j2"),
        "insert_adopt": rounded(codec.encode_insert(Insert(10, Batch(), settle=True, epoch=EPOCH, changes=(place,)))),
    }


def _stamped_answers() -> dict[str, bytes]:
    solver = Solver(Options(mode="all-batch"))
    solver.stage(stamped())
    report = _short(solver.step(settle=True))
    variables, factors = solver.graph()
    groups, changed = _variables(variables), _variables(solver.changed())
    return {
        "insert_stamps": codec.encode_insert(Insert(1, stamped(), settle=True, epoch=EPOCH)),
        "estimate_stamps": codec.encode_estimate(Estimate(EPOCH, 1, groups)),
        "delta_stamps": codec.encode_delta(Delta(EPOCH, 1, 0, changed, report)),
        "graph_stamps": codec.encode_graph(MapGraph(EPOCH, 1, Batch(groups, tuple(_factors(factors))))),
    }


def _done(optimum: Optimum, job: str) -> bytes:
    return codec.encode_job_done(JobDone(job, "batch", codec.encode_optimum(optimum), _SECONDS))


def _short(report: Any) -> dict[str, Any]:
    """What of a report is the same on every machine."""
    told = {name: getattr(report, name) for name in ("mode", "strategy", "because", "iterations", "chi2", "converged")}
    return told | {"step_ms": _MS}


def _variables(groups: Any) -> tuple[Variables, ...]:
    return tuple(Variables(g.kind, g.keys, g.values, g.fixed, g.stamps) for g in groups)


def _factors(groups: Any) -> list[Factors]:
    return [Factors(g.kind, g.keys, g.measured, g.information, g.loss, g.scale) for g in groups]
