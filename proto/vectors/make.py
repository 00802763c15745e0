"""Write the golden messages: one .msgpack per message and a .json that says what is in it.

    python proto/vectors/make.py [FOLDER]        (default: the folder of this file)

A client in another language reads the .msgpack and compares with the .json, or builds the message from the .json and
compares with the .msgpack.  In the .json a bin is {"i64": [...]}, {"f64": [...]} or {"u8": [...]} (little-endian
columns, flattened) or {"msgpack": {...}} (a message inside a message); floats are written so that they read back bit
for bit.
The bytes are part of wire version 1: they never change; new optional fields get new files.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from factorbus.proto import asking, codec
from factorbus.proto import asking_codec as asked
from factorbus.proto import repair_codec as repairs
from factorbus.proto.kinds import FACTOR_KINDS, LOSSES
from factorbus.proto.messages import (
    Accepted,
    Batch,
    Change,
    Chi2,
    Delta,
    Estimate,
    Factors,
    Graph,
    Insert,
    Job,
    JobDone,
    Optimum,
    Variables,
)
from factorbus.proto.problems import BetterOptimum, Busy
from factorbus.proto.stamps import LEAST_STAMP, NO_STAMP
from factorbus.proto.symbols import symbol

_COLUMNS = {"keys": "i64", "values": "f64", "measured": "f64", "information": "f64", "scale": "f64"}
# Of the questions about uncertainty and their answers, §16.
_COLUMNS |= dict.fromkeys(("others", "dims", "other_dims", "landmarks", "sightings", "candidates"), "i64")
_COLUMNS |= dict.fromkeys(("covariance", "distance", "threshold", "gain", "distances"), "f64")
_COLUMNS |= dict.fromkeys(("plausible", "matched"), "u8")
# Of changes and repairs, §17.
_COLUMNS |= {"factors": "i64", "ids": "i64", "weight": "f64"}
# Of variables, §4.
_COLUMNS |= {"stamps": "i64"}


def main() -> None:
    """Write all vectors."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for name, data in vectors().items():
        (folder / f"{name}.msgpack").write_bytes(data)
        (folder / f"{name}.json").write_text(described(data))


def vectors() -> dict[str, bytes]:
    """The golden messages by name."""
    report = {"mode": "all-batch", "strategy": "all-batch", "iterations": 2, "chi2": 0.25, "step_ms": 1.5}
    pair = (_poses(fixed=True, first=0, values=[[0, 0, 0]]), _poses(first=1, values=[[1.5, 0.25, 0.125]]))
    graph = Graph(7, 2, Batch(pair, (_odometry(0),)))
    optimum = Optimum(0.25, 3, (_poses(first=1, values=[[1.5, 0.25, 0.125]]),))
    return {
        "insert": codec.encode_insert(Insert(1, Batch(pair, (_odometry(0),)), epoch=7)),
        "insert_without_values": codec.encode_insert(Insert(2, Batch((_poses(first=2),), (_odometry(1),)), epoch=7)),
        "insert_all_kinds": codec.encode_insert(Insert(3, _every_kind(), epoch=7)),
        "insert_sights": codec.encode_insert(Insert(5, _sights(), epoch=7)),
        "insert_other_kinds": codec.encode_insert(Insert(8, _other_kinds(), epoch=7)),
        "insert_linear_kinds": codec.encode_insert(Insert(9, _linear_kinds(), epoch=7)),
        "insert_points": codec.encode_insert(Insert(6, Batch(), epoch=7, points_below=0.1)),
        "insert_changes": codec.encode_insert(Insert(7, Batch(), settle=True, epoch=7, changes=_changes())),
        "insert_marginalise": codec.encode_insert(
            Insert(9, Batch(), epoch=7, changes=(Change("marginalise", keys=np.array([symbol("x", 1)])),))
        ),
        "insert_stamps": codec.encode_insert(Insert(11, Batch(_stamped(), (_odometry(0), _odometry(1))), epoch=7)),
        "estimate_stamps": codec.encode_estimate(Estimate(7, 3, _stamped())),
        "delta_stamps": codec.encode_delta(Delta(7, 3, 2, _stamped()[1:], report)),
        "graph_stamps": codec.encode_graph(Graph(7, 3, Batch(_stamped(), (_odometry(0), _odometry(1))))),
        "insert_settle": codec.encode_insert(Insert(4, Batch(), settle=True, epoch=7)),
        "accepted": codec.encode_accepted(Accepted(1, 7, 1, 0, 1, report)),
        # What readers do without: `report` is optional.
        "accepted_without_report": codec.encode_map(
            {"sequence": 1, "epoch": 7, "revision": 1, "first_factor": 0, "folded": 1}
        ),
        "insert_losses": codec.encode_insert(Insert(10, Batch(factors=_losses()), epoch=7)),
        "estimate": codec.encode_estimate(Estimate(7, 2, pair)),
        "estimate_empty": codec.encode_estimate(Estimate(7, 2, ())),
        "delta": codec.encode_delta(Delta(7, 2, 1, (pair[1],), report)),
        "graph": codec.encode_graph(graph),
        "graph_ids": codec.encode_graph(Graph(7, 3, Batch(pair, (_odometry(0)._replace(ids=np.array([4])),)))),
        "chi2": codec.encode_chi2(Chi2(7, 2, 0.25)),
        "chi2_batch": codec.encode_chi2(Chi2(7, 2, 0.25, 0.125, "w1", 0.5)),
        "chi2_better": codec.encode_chi2(
            Chi2(7, 2, 0.25, 0.125, "w1", 0.5, "rotations", BetterOptimum(0.25, 0.125, "rotations"), optimum.variables)
        ),
        "ask_chi2_values": codec.encode_map({"batch": True, "timeout_s": 10.0, "values": True}),
        "insert_adopt": codec.encode_insert(
            Insert(10, Batch(), settle=True, epoch=7, changes=(_adopted(optimum.variables[0]),))
        ),
        "job_done_start": codec.encode_job_done(
            JobDone("j1", "batch", codec.encode_optimum(replace(optimum, start="rotations")), 0.5)
        ),
        "job": codec.encode_job(Job("j1", "batch", codec.encode_graph(graph))),
        "job_done": codec.encode_job_done(JobDone("j1", "batch", codec.encode_optimum(optimum), 0.5)),
        "problem": codec.encode_problem(Busy(256, 0.05)),
        "ask_estimate": codec.encode_keys_asked(None),
        "ask_estimate_keys": codec.encode_keys_asked(np.array([symbol("x", 1), symbol("l", 5)])),
        "ask_estimate_none": codec.encode_keys_asked(np.array([], np.int64)),
        "ask_chi2": codec.encode_map({"batch": True, "timeout_s": 10.0}),
        "ask_export": codec.encode_map({"format": "g2o"}),
        "ask_export_kitti": codec.encode_map({"format": "kitti"}),
        "admin_create": codec.encode_map({"map": "kitchen", "mode": "auto"}),
        "admin_fork": codec.encode_map({"map": "kitchen", "as": "what-if", "request": 4711}),
        "event": codec.encode_map({"event": "created", "epoch": 7, "revision": 0}),
        **_about_uncertainty(),
    }


def _about_uncertainty() -> dict[str, bytes]:
    x = [symbol("x", i) for i in range(4)]
    pairs, two, odometry = np.array([[x[1], x[2]]]), np.array(x[1:3]), (_odometry(1),)
    block = np.array([[0.25, 0.0, 0.125], [0.0, 0.5, 0.0], [0.125, 0.0, 0.0625]])
    group = asking.CovarianceGroup("se2", np.array(x[1:2]), block[None])
    relative = asking.CovarianceGroup("se2", pairs, block[None], np.array([[1.5, 0.25, 0.125]]))
    dims, matrix = np.array([3, 3]), np.vstack([np.hstack([2 * block, block]), np.hstack([block, 2 * block])])
    sights = np.array([[2.0, 1.0], [3.0, 0.0]])
    account = {"factor": 0, "kind": "between_se2", "keys": x[:2], "chi2": 0.25, "without": None, "dims": 3}
    return {
        "ask_covariance": asked.encode_ask_covariance(asking.AskCovariance()),
        "ask_covariance_cross": asked.encode_ask_covariance(asking.AskCovariance("cross", two, np.array(x[:1]))),
        "ask_covariance_relative": asked.encode_ask_covariance(asking.AskCovariance("relative", pairs)),
        "covariances": asked.encode_covariances(asking.Covariances(7, 2, "diagonal", (group,))),
        "covariances_relative": asked.encode_covariances(asking.Covariances(7, 2, "relative", (relative,))),
        "covariances_joint": asked.encode_covariances(
            asking.Covariances(7, 2, "joint", keys=two, dims=dims, covariance=matrix)
        ),
        "covariances_cross": asked.encode_covariances(
            asking.Covariances(7, 2, "cross", (), two, dims, np.array(x[3:]), np.array([3]), matrix[:, :3])
        ),
        "ask_gate": asked.encode_ask_gate(asking.AskGate(odometry, 0.99)),
        "gated": asked.encode_gated(
            asking.Gated(7, 2, np.array([0.5]), np.array([3]), np.array([11.25]), np.array([True]))
        ),
        "ask_gain": asked.encode_ask_gain(asking.AskGain(odometry)),
        "gained": asked.encode_gained(asking.Gained(7, 2, np.array([1.25]))),
        "ask_associate": asked.encode_ask_associate(
            asking.AskAssociate(x[1], "landmark_se2", sights, np.tile([4.0, 0.0, 4.0], (2, 1)), two, 0.95)
        ),
        "associated": asked.encode_associated(
            asking.Associated(
                7, 2, np.array([x[2], 0]), np.array([True, False]), 0.5, 2, 5.75, True,
                np.array([0, 0]), np.array([x[2], x[1]]), np.array([0.5, 4.5]),
            )
        ),
        "ask_why": asked.encode_ask_why(asking.AskWhy(key=x[1])),
        "ask_why_factor": asked.encode_ask_why(asking.AskWhy(factor=0)),
        "why": asked.encode_why(asking.Why(7, 2, {}, account, {"strategy": "tree", "because": "2 variables bent"})),
        "ask_repair": repairs.encode_ask_repair(asking.AskRepair(np.array([4, 17]), 0.95, values=True)),
        "repaired": repairs.encode_repaired(
            asking.Repaired(
                7, 2, np.array([17]), np.array([250.5]), 2, 300.25, 12.5, 0.5,
                (_poses(first=1, values=[[1.5, 0.25, 0.125]]),),
            )
        ),
    }  # fmt: skip


def _adopted(group: Variables) -> Change:
    return Change("place", keys=group.keys, kind=group.kind, values=group.values, carry=True)


def _changes() -> tuple[Change, ...]:
    x = np.array([symbol("x", i) for i in range(1, 3)])
    ids = np.array([4, 17])
    return (
        Change("remove_factors", ids),
        Change("remove_variables", keys=x, alone=True),
        Change("remove_variables", keys=x[:1]),
        Change("loss", ids, loss="dcs", scale=np.array([1.0, 2.5])),
        Change("loss", ids[:1]),
        Change("weigh", ids, weight=np.array([0.5, 0.25])),
        Change("fix", keys=x),
        Change("free", keys=x[:1]),
        Change("place", keys=x[:1], kind="se2", values=np.array([[1.5, 0.25, 0.125]])),
    )


def described(data: bytes) -> str:
    """The .json of a message."""
    return json.dumps(_plain(msgpack.unpackb(data)), indent=1, ensure_ascii=False) + "\n"


def _poses(first: int, values: Any = None, fixed: bool = False) -> Variables:
    rows = None if values is None else np.array(values, float)
    count = 1 if rows is None else len(rows)
    return Variables("se2", np.array([symbol("x", first + i) for i in range(count)]), rows, fixed)


def _stamped() -> tuple[Variables, ...]:
    """A fixed pose at the time 0; two, of which one has a time and the other none; a point with the least there is."""
    first, both = _poses(first=0, values=[[0, 0, 0]], fixed=True), [[1.5, 0.25, 0.125], [3.0, 0.75, 0.25]]
    return (
        first._replace(stamps=np.array([0])),
        _poses(first=1, values=both)._replace(stamps=np.array([1_403_636_579_763_555_584, NO_STAMP])),
        Variables("point2", np.array([symbol("l", 1)]), np.array([[3.0, 4.0]]), True, np.array([LEAST_STAMP])),
    )


def _odometry(first: int) -> Factors:
    keys = np.array([[symbol("x", first), symbol("x", first + 1)]])
    return Factors("between_se2", keys, np.array([[1.5, 0.25, 0.125]]), np.array([[100.0, 0, 0, 100, 0, 400]]))


def _losses() -> tuple[Factors, ...]:
    """An odometry with each loss."""
    edge = _odometry(0)
    return tuple(edge._replace(loss=loss, scale=np.array([1.5 + n])) for n, loss in enumerate(LOSSES))


def _every_kind() -> Batch:
    x, y, l, p = (symbol(letter, 1) for letter in "xylp")
    unit2, unit3, unit6 = (np.array([np.eye(r)[np.triu_indices(r)]]) for r in (2, 3, 6))
    turned = [1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8]
    variables = (
        Variables("se2", np.array([x]), np.array([[1.0, 2.0, 0.5]])),
        Variables("se3", np.array([y, y + 1]), np.array([turned, turned])),
        Variables("point2", np.array([l]), np.array([[3.0, 4.0]])),
        Variables("point3", np.array([p]), np.array([[5.0, 6.0, 7.0]])),
    )
    factors = (
        Factors("prior_se2", np.array([[x]]), np.array([[1.0, 2.0, 0.5]]), unit3),
        Factors("prior_se3", np.array([[y]]), np.array([turned]), unit6),
        Factors("prior_point2", np.array([[l]]), np.array([[3.0, 4.0]]), unit2),
        Factors("prior_point3", np.array([[p]]), np.array([[5.0, 6.0, 7.0]]), unit3),
        Factors("between_se3", np.array([[y, y + 1]]), np.array([[0.0, 0, 0, 0, 0, 0, 1]]), unit6),
        Factors("landmark_se2", np.array([[x, l]]), np.array([[2.0, 1.0]]), unit2),
        Factors("landmark_se3", np.array([[y, p]]), np.array([[4.0, 4.0, 4.0]]), unit3),
        Factors("bearing_range_se2", np.array([[x, l]]), np.array([[0.25, 2.5]]), unit2),
    )
    return Batch(variables, factors)


def _other_kinds() -> Batch:
    """Positions, headings, attitudes, ranges, bearings, linear factors."""
    x, y, l, p = (symbol(letter, 1) for letter in "xylp")
    unit1, unit2, unit3, unit6 = (np.array([np.eye(r)[np.triu_indices(r)]]) for r in (1, 2, 3, 6))
    here, turned = [1.0, 2.0, 0.5], [1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8]
    H2, H3 = np.diag([1.0, 2.0, 0.5]).ravel().tolist(), np.diag([1.0, 2.0, 0.5, 4.0, 0.25, 8.0]).ravel().tolist()
    b2, b3 = [0.125, 0.25, -0.5], [0.125, 0.25, -0.5, 0.0, 1.0, 0.75]
    return Batch(
        factors=(
            Factors("position_se2", np.array([[x]]), np.array([[4.0, 5.0, 0.5, 0.25]]), unit2),
            Factors("position_se3", np.array([[y]]), np.array([[4.0, 5.0, 6.0, 0.5, 0.25, 0.125]]), unit3),
            Factors("heading_se2", np.array([[x]]), np.array([[0.75]]), unit1),
            Factors("attitude_se3", np.array([[y]]), np.array([[0.5, 0.0, -9.75, 0.0, 0.0, -1.0]]), unit3),
            Factors("range_se2", np.array([[x, l]]), np.array([[2.5]]), unit1),
            Factors("range_se3", np.array([[y, p]]), np.array([[3.5]]), unit1),
            Factors("bearing_se2", np.array([[x, l]]), np.array([[-0.25]]), unit1),
            Factors("bearing_se3", np.array([[y, p]]), np.array([[0.0, 3.0, 4.0]]), unit3),
            Factors("linear_se2", np.array([[x]]), np.array([[*here, *H2, *b2]]), unit3),
            Factors("linear_se3", np.array([[y]]), np.array([[*turned, *H3, *b3]]), unit6),
            Factors("linear_pair_se2", np.array([[x, x + 1]]), np.array([[*here, *here, *H2, *H2, *b2]]), unit3),
            Factors("linear_pair_se3", np.array([[y, y + 1]]), np.array([[*turned, *turned, *H3, *H3, *b3]]), unit6),
        )
    )


def _linear_kinds() -> Batch:
    """Linear factors of points and features, and a form in pieces: its number, what is too much, the rest, the pair."""
    plane, space = (symbol("x", 1), symbol("l", 1)), (symbol("y", 1), symbol("p", 1), symbol("f", 1))
    sent = ("linear_se2", "linear_se3", "linear_pair_se2", "linear_pair_se3")  # in `_other_kinds`
    names = [name for name in FACTOR_KINDS if name.startswith("linear") and name not in sent]
    of = {"se2": plane[0], "point2": plane[1], "se3": space[0], "point3": space[1], "idp": space[2]}
    groups = []
    for name in names:
        kind = FACTOR_KINDS[name]
        keys = np.array([[of[end] + (e if kind.connects[0] == end else 0) for e, end in enumerate(kind.connects)]])
        numbers = np.array([(n % 8 - 3) / 4 for n in range(kind.size)])
        if kind.connects[0] == "se3":
            numbers[3:7] = 0.0, 0.0, 0.6, 0.8
        groups.append(Factors(name, keys, numbers[None], np.eye(kind.dim)[np.triu_indices(kind.dim)][None]))
    two, three = (np.eye(r)[np.triu_indices(r)] for r in (2, 3))
    here, there = [1.0, 2.0, 0.5], [3.0, 4.0]
    H2, H3 = np.eye(2).ravel().tolist(), np.eye(3).ravel().tolist()
    pose = [[*here, *[0.0] * 9, 0.5, 0, 0], [*here, *H3, 0, 0, 0], [*here, *H3, 0.25, 0, 0]]
    point = [[*there, *H2, 0, 0], [*there, *H2, 0, 0.25]]
    pair = [*here, *there, 0.5, 0, 0, 0, 0.5, 0, *H2, 0, 0]
    groups += [
        Factors("linear_se2", np.full((2, 1), plane[0]), np.array(pose[:2]), np.array([three, -0.5 * three])),
        Factors("linear_point2", np.full((2, 1), plane[1]), np.array(point), np.array([-two, 2.0 * two])),
        Factors("linear_se2", np.full((1, 1), plane[0]), np.array(pose[2:]), np.array([three])),
        Factors("linear_pair_se2_point2", np.array([plane]), np.array([pair]), two[None]),
    ]
    return Batch(factors=tuple(groups))


def _sights() -> Batch:
    """What cameras see, with and without losses."""
    x, f, p = (symbol(letter, 1) for letter in "xfp")
    unit2, unit6 = (np.array([np.eye(r)[np.triu_indices(r)]]) for r in (2, 6))
    radtan = [1.0, 400.0, 401.0, 320.0, 240.0, 0.0, -0.25, 0.125, 0.001, -0.002, 0.0]
    radial = [0.0, 195.5, 196.0, 162.0, 125.0, 0.0, 0.0112, 0.0112, 0.0633, 0.0139, 0.0]
    variables = (
        Variables("se3", np.array([x, x + 1]), np.array([[0.0, 0, 0, 0, 0, 0, 1], [0.5, 0, 0, 0, 0, 0, 1]])),
        Variables("idp", np.array([f])),
        Variables("point3", np.array([p]), np.array([[0.25, 0.5, 4.0]])),
    )
    factors = (
        Factors("idp_first", np.array([[x, f]]), np.array([[330.0, 250.0, 0.25, *radtan]]), unit6),
        Factors(
            "idp_seen", np.array([[x + 1, f]]), np.array([[280.0, 250.0, *radtan]]), unit2, "huber", np.array([1.5])
        ),
        Factors("point_seen", np.array([[x, p]]), np.array([[175.0, 150.0, *radial]]), unit2, "dcs", np.array([2.0])),
    )
    return Batch(variables, factors)


def _plain(content: Any, name: str = "") -> Any:
    if isinstance(content, dict):
        return {key: _plain(value, key) for key, value in content.items()}
    if isinstance(content, list):
        return [_plain(item) for item in content]
    if isinstance(content, bytes):
        if name not in _COLUMNS:
            return {"msgpack": _plain(msgpack.unpackb(content))}
        dtype = _COLUMNS[name]
        return {dtype: np.frombuffer(content, {"i64": "<i8", "f64": "<f8", "u8": "u1"}[dtype]).tolist()}
    return content


if __name__ == "__main__":
    main()
