"""Write the golden messages: one .msgpack per message and a .json that says what is in it.

    python proto/vectors/make.py [FOLDER]        (default: the folder of this file)

A client in another language reads the .msgpack and compares with the .json, or builds the message from the .json and
compares with the .msgpack.  In the .json a bin is {"i64": [...]}, {"f64": [...]} or {"u8": [...]} (little-endian
columns, flattened) or {"msgpack": {...}} (a message inside a message); floats are written so that they read back bit
for bit.
The bytes are part of wire version 1: they never change; new optional fields get new files.  Answers, and the inserts
that lead to them, are made in `kitchen.py`: their numbers are those of a stated map.
"""

import json
import runpy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from factorbus.proto import codec
from factorbus.proto.inertial import RESIDUAL, ImuForm
from factorbus.proto.interest import Interest, channel_of, checked_interest, filter_of
from factorbus.proto.interest_codec import (
    AskInterest,
    InterestAnswer,
    InterestDelta,
    encode_ask_interest,
    encode_interest_answer,
    encode_interest_delta,
    filter_map,
)
from factorbus.proto.kinds import FACTOR_KINDS, LOSSES, VARIABLE_KINDS, FactorKind, inertial_kind, linear_kind
from factorbus.proto.messages import (
    Batch,
    Change,
    Estimate,
    Factors,
    Insert,
    Variables,
)
from factorbus.proto.problems import Busy
from factorbus.proto.records import (
    JournalPlace,
    RecordsAnswer,
    RecordsAsk,
    RecordsPush,
    SentRecord,
    encode_records_answer,
    encode_records_ask,
    encode_records_push,
)
from factorbus.proto.similarity_kinds import SIMILARITY_KINDS
from factorbus.proto.symbols import symbol

# The map that inserts and answers are of: stated there, and solved.
_KITCHEN = runpy.run_path(str(Path(__file__).with_name("kitchen.py")))
_TESTED = runpy.run_path(str(Path(__file__).with_name("tested.py")))
_BUDGETS = runpy.run_path(str(Path(__file__).with_name("budgets.py")))
_COLUMNS = {"keys": "i64", "values": "f64", "measured": "f64", "information": "f64", "scale": "f64"}
# Of the questions about uncertainty and their answers, §16.
_COLUMNS |= dict.fromkeys(("others", "dims", "other_dims", "landmarks", "observations", "candidates"), "i64")
_COLUMNS |= dict.fromkeys(("covariance", "distance", "threshold", "gain", "distances"), "f64")
_COLUMNS |= dict.fromkeys(("plausible", "matched"), "u8")
# Of changes and repairs, §17.
_COLUMNS |= {"factors": "i64", "ids": "i64", "weight": "f64"}
# Of variables, §4, and interests, §18.
_COLUMNS |= {"stamps": "i64", "box": "f64"}
# Of replicas, §19.
_COLUMNS |= {"chain": "u8", "named": "i64"}
# Of closures that are tested, §20.
_COLUMNS |= {"chance": "f64"} | dict.fromkeys(("tried", "came", "changed"), "i64")
# Of the steps that a map has made, §8.
_COLUMNS |= {"revisions": "i64", "eliminated": "i64", "chi2": "f64", "step_ms": "f64"}
_CUTS = (slice(None, -1), slice(-1, None))


def main() -> None:
    """Write all vectors."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    (folder / "kinds").mkdir(exist_ok=True)
    for name, data in vectors().items():
        (folder / f"{name}.msgpack").write_bytes(data)
        (folder / f"{name}.json").write_text(described(data))


def vectors() -> dict[str, bytes]:
    """The golden messages by name."""
    kitchen = _KITCHEN["messages"]()
    return {
        **kitchen,
        **_records(17),
        **_TESTED["messages"](),
        **_BUDGETS["messages"](),
        **_interests(codec.decode_estimate(kitchen["estimate"])),
        **{
            f"kinds/{name}": codec.encode_insert(Insert(1, _one_of(kind), epoch=7))
            for name, kind in FACTOR_KINDS.items()
        },
        "insert_all_kinds": codec.encode_insert(Insert(3, _every_kind(), epoch=7)),
        "insert_observations": codec.encode_insert(Insert(5, _observations(), epoch=7)),
        "insert_other_kinds": codec.encode_insert(Insert(8, _other_kinds(), epoch=7)),
        "insert_mounts": codec.encode_insert(Insert(10, _mounts(), epoch=7)),
        "insert_calibration": codec.encode_insert(Insert(11, _calibration(), epoch=7)),
        "insert_inertial": codec.encode_insert(Insert(11, _inertial(), epoch=7)),
        "insert_linear_kinds": codec.encode_insert(Insert(9, _linear_kinds(), epoch=7)),
        "insert_similar": codec.encode_insert(Insert(12, _similar_kinds(), epoch=7)),
        "insert_own_kind": codec.encode_insert(Insert(11, _own_kind(), epoch=7)),
        "insert_points": codec.encode_insert(Insert(6, Batch(), epoch=7, convert_below=0.1)),
        "insert_changes": codec.encode_insert(Insert(7, Batch(), settle=True, epoch=7, changes=_changes())),
        "insert_marginalize": codec.encode_insert(
            Insert(9, Batch(), epoch=7, changes=(Change("marginalize", keys=np.array([symbol("x", 1)])),))
        ),
        "insert_settle": codec.encode_insert(Insert(4, Batch(), settle=True, epoch=7)),
        # What readers do without: `report` is optional.
        "accepted_without_report": codec.encode_map(
            {"sequence": 1, "epoch": 7, "revision": 1, "first_factor": 0, "applied": 1}
        ),
        "insert_losses": codec.encode_insert(Insert(10, Batch(factors=_losses()), epoch=7)),
        "estimate_empty": codec.encode_estimate(Estimate(7, 2, ())),
        "ask_chi2_values": codec.encode_map({"batch": True, "timeout_s": 10.0, "values": True}),
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
    }


def _interests(estimate: Estimate) -> dict[str, bytes]:
    """A question for a part of the map whose estimate this is, the answers, and what its channel carries then."""
    interest = checked_interest(Interest(("x", ""), ("se2",), (-1.0, -1.0, 10.0, 10.0), 1000, 4000))
    channel, epoch, revision = channel_of(interest), estimate.epoch, estimate.revision
    poses = filter_of(interest).pick(estimate.variables)
    first, rest = (
        tuple(g._replace(keys=g.keys[cut], values=np.asarray(g.values)[cut]) for g in poses) for cut in _CUTS
    )
    left = tuple(Variables(group.kind, group.keys) for group in first)
    named = InterestAnswer(epoch, revision, channel, 4711, 0, 30.0)
    return {
        "ask_interest": encode_ask_interest(AskInterest(checked_interest(Interest()))),
        "ask_interest_following": encode_ask_interest(AskInterest(interest, True, 4711, 12)),
        "interest_answer": encode_interest_answer(named),
        "interest_answer_whole": encode_interest_answer(
            named._replace(whole=True, variables=first, waiting=1, converged=True, converging=False)
        ),
        "interest_answer_missed": encode_interest_answer(named._replace(number=14, variables=rest, gone=left)),
        "interest_delta": encode_interest_delta(
            InterestDelta(epoch, revision, revision - 1, 4711, 13, rest, converged=True, converging=False)
        ),
        "interest_delta_gone": encode_interest_delta(
            InterestDelta(epoch, revision, revision, 4711, 14, gone=left, waiting=3)
        ),
        "ask_part": codec.encode_map(filter_map(interest)),
    }


def _records(epoch: int) -> dict[str, bytes]:
    """Questions for records, an answer that has none, and a further step that a replica sends."""
    place = JournalPlace(3, bytes(range(16)))
    return {
        "ask_records": encode_records_ask(RecordsAsk(JournalPlace())),
        "ask_records_named": encode_records_ask(RecordsAsk(place, (4711, 12), 4096)),
        "records_answer_none": encode_records_answer(RecordsAnswer(epoch, place, same=False)),
        "records_push": encode_records_push(RecordsPush(place, (SentRecord(5, (), further=True),))),
    }


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


def _losses() -> tuple[Factors, ...]:
    """An odometry with each loss."""
    edge = _KITCHEN["odometry"](0)
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
            Factors("range_between_se2", np.array([[x, x + 1]]), np.array([[2.5]]), unit1),
            Factors("range_between_se3", np.array([[y, y + 1]]), np.array([[3.5]]), unit1),
            Factors("length_vector3", np.array([[symbol("g", 1)]]), np.array([[9.8125]]), unit1),
            Factors("bearing_se2", np.array([[x, l]]), np.array([[-0.25]]), unit1),
            Factors("bearing_se3", np.array([[y, p]]), np.array([[0.0, 3.0, 4.0]]), unit3),
            Factors("linear_3_se2", np.array([[x]]), np.array([[*here, *H2, *b2]]), unit3),
            Factors("linear_6_se3", np.array([[y]]), np.array([[*turned, *H3, *b3]]), unit6),
            Factors("linear_3_se2_se2", np.array([[x, x + 1]]), np.array([[*here, *here, *H2, *H2, *b2]]), unit3),
            Factors("linear_6_se3_se3", np.array([[y, y + 1]]), np.array([[*turned, *turned, *H3, *H3, *b3]]), unit6),
        )
    )


def _one_of(kind: FactorKind) -> Batch:
    """A factor of this kind that measures the example of its declaration."""
    keys = np.array([[symbol("x", n) for n in range(1, 1 + len(kind.connects))]])
    unit = np.eye(kind.dim)[np.triu_indices(kind.dim)]
    return Batch(factors=(Factors(kind.name, keys, np.array([kind.example]), unit[None]),))


def _linear_kinds() -> Batch:
    """Linear factors of one variable, of two, and of more, with few rows and with many."""
    plane, space = (symbol("x", 1), symbol("l", 1)), (symbol("y", 1), symbol("p", 1), symbol("f", 1))
    of = {"se2": plane[0], "point2": plane[1], "se3": space[0], "point3": space[1], "idp": space[2],
          "vector1": symbol("v", 1), "vector3": symbol("v", 3)}  # fmt: skip
    groups = []
    for rows, ends in (
        (2, ("point2",)), (3, ("point3",)), (6, ("idp",)), (2, ("point2", "point2")), (2, ("se2", "point2")),
        (3, ("se3", "point3")), (6, ("se3", "idp")), (4, ("point3", "idp")), (9, ("se2", "point2", "se2")),
        (1, ("point3", "se3", "se3", "idp")), (3, ("se3", "vector3", "vector1")),
    ):  # fmt: skip
        kind = linear_kind(rows, ends)
        keys = np.array([[of[end] + ends[:n].count(end) for n, end in enumerate(ends)]])
        numbers, here = np.array([(n % 8 - 3) / 4 for n in range(kind.size)]), 0
        for end in ends:
            if end == "se3":
                numbers[here + 3 : here + 7] = 0.0, 0.0, 0.6, 0.8
            here += VARIABLE_KINDS[end].size
        groups.append(Factors(kind.name, keys, numbers[None], np.eye(rows)[np.triu_indices(rows)][None]))
    return Batch(tuple(_vectors()), tuple(groups))


def _similar_kinds() -> Batch:
    """Rotations, and poses with a scale: variables, and a factor of each of their kinds."""
    values = {"so3": [0.0, 0.0, 0.6, 0.8], "sim3": [1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8, 1.5], "point3": [5.0, 6.0, 7.0]}
    letters, groups = {"so3": "r", "sim3": "s", "point3": "p"}, []
    for kind in SIMILARITY_KINDS:
        keys = [symbol(letters[end], 1 + n) for n, end in enumerate(kind.connects)]
        unit = np.eye(kind.dim)[np.triu_indices(kind.dim)]
        groups.append(Factors(kind.name, np.array([keys]), np.array([kind.example]), unit[None]))
    variables = (
        Variables(kind, symbol(letters[kind], 1) + np.arange(2), np.array([row, row])) for kind, row in values.items()
    )
    return Batch(tuple(variables), tuple(groups))


def _own_kind() -> Batch:
    """A kind that a client has written itself: its name is its formula."""
    kind = "near(a:se3,l:point3,bias:vector1,z:1)=subtract(add(norm(act(inverse(a),l)),bias),z)"
    keys = np.array([[symbol("y", 1), symbol("p", 1), symbol("v", 1)]])
    return Batch(factors=(Factors(kind, keys, np.array([[2.5]]), np.array([[4.0]])),))


def _vectors() -> Iterator[Variables]:
    """One of each size."""
    for n in range(1, 10):
        yield Variables(f"vector{n}", np.array([symbol("v", n)]), np.array([[(k - 4) / 8 for k in range(n)]]))


def _mounts() -> Batch:
    """What sensors measure whose mount is a variable: the key of the mount is the last of each row."""
    return _derived(lambda kind: "mount" in kind.modifiers)


def _calibration() -> Batch:
    """Kinds with a bias, a scale, another frame, a lever arm or a clock's offset that is a variable, and velocities."""
    return _derived(lambda kind: kind.roles != () and "mount" not in kind.modifiers)


def _derived(wanted: Callable[[FactorKind], bool]) -> Batch:
    """A factor of each kind that is wanted; places have numbers from 1 on, what is no place has 0."""
    groups = []
    for name, kind in FACTOR_KINDS.items():
        if wanted(kind):
            keys = [
                _named(end, role, n, kind.connects[0])
                for n, (end, role) in enumerate(zip(kind.connects, kind.roles, strict=True))
            ]
            unit = np.eye(kind.dim)[np.triu_indices(kind.dim)]
            groups.append(Factors(name, np.array([keys]), np.array([kind.example]), unit[None]))
    return Batch(factors=tuple(groups))


def _named(end: str, role: str, n: int, space: str) -> int:
    """The key of the n-th variable of a factor, by its kind and role."""
    letters = {"se2": "x", "se3": "y", "point2": "l", "point3": "p"}
    aside = {"mount": "mn", "frame": "fg"}
    if role in aside:
        return symbol(aside[role][space == "se3"], 0)
    return symbol(letters[end], 1 + n) if end in letters else symbol("v", int(end.removeprefix("vector")))


def _inertial() -> Batch:
    """An IMU's samples between two moments, and what others are integrated to; what is known of the first of them."""
    before, after = ([symbol(letter, n) for letter in "xvb"] for n in (1, 2))
    kinds, (mount, gravity) = ("se3", "vector3", "vector6"), (symbol("m", 1), symbol("g", 1))
    first = [0.0] * 6 + [1.0], [1.5, 0.25, 0.0], [0.0] * 6
    further = Variables("se3", np.array([mount]), np.array([[0.25, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]]))
    factors = []
    for form in (ImuForm(2), ImuForm(2, mount=True), ImuForm(0), ImuForm(0, mount=True, gravity=True)):
        kind, unit = inertial_kind(form), np.eye(RESIDUAL)[np.triu_indices(RESIDUAL)][None]
        keys = np.array([[*before, *after, *[mount] * form.mount, *[gravity] * form.gravity]])
        factors.append(Factors(kind.name, keys, np.array([kind.example]), unit))
    return Batch(
        (
            *(Variables(of, np.array([key]), np.array([x])) for of, key, x in zip(kinds, before, first, strict=True)),
            *(Variables(of, np.array([key])) for of, key in zip(kinds, after, strict=True)),
            further,
            Variables("vector3", np.array([gravity]), np.array([[0.0, 0.25, -9.75]])),
        ),
        tuple(factors),
    )


def _observations() -> Batch:
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
