"""What the contract says, asked by a client written from it alone: MessagePack and NumPy, and no codec of ours.

Each test is a row that such a client had found wrong, ambiguous or not said.
"""

import itertools
import time
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
from bare import Bare, bare
from scipy.optimize import minimize_scalar

from factorbus.proto.problems import Refused

HERE = "factorbus/v1"
STEADY = [100.0, 0, 0, 100, 0, 400]
LOSSES = {
    "huber": lambda s, k: s if s <= k * k else 2 * k * np.sqrt(s) - k * k,
    "cauchy": lambda s, k: k * k * np.log1p(s / k**2),
    "geman-mcclure": lambda s, k: k * k * s / (k * k + s),
    "tukey": lambda s, k: k * k / 3 * (1 - max(1 - s / k**2, 0.0) ** 3),
    "dcs": lambda s, k: s if s <= k * k else k * k * (3 * s - k * k) / (s + k * k),
}
_number = itertools.count()


@pytest.fixture(scope="module")
def client(endpoint: str) -> Iterator[Bare]:
    with bare(endpoint) as opened:
        yield opened


def key(text: str) -> int:
    return ord(text[0]) << 56 | int(text[1:])


def ints(*numbers: int | str) -> bytes:
    return np.array([key(each) if isinstance(each, str) else each for each in numbers], "<i8").tobytes()


def floats(*numbers: float) -> bytes:
    return np.array(numbers, "<f8").tobytes()


def packed(message: dict[str, Any]) -> bytes:
    made = msgpack.packb(message)
    assert made is not None
    return made


def ask(client: Bare, to: str, **message: Any) -> Any:
    return sent(client, to, packed(message))


def sent(client: Bare, to: str, payload: bytes) -> Any:
    came = client.ask(f"{HERE}/{to}", payload)
    return msgpack.unpackb(came) if isinstance(came, bytes) else came


def insert(client: Bare, name: str, **message: Any) -> Any:
    return ask(client, f"map/{name}/in/page-{next(_number)}", sequence=1, **message)


def between(a: str, b: str, **more: Any) -> dict[str, Any]:
    return {
        "kind": "between_se2",
        "keys": ints(a, b),
        "measured": floats(1, 0, 0.1),
        "information": floats(*STEADY),
    } | more


def chain(client: Bare, name: str, poses: int = 5) -> str:
    """A map of poses in a row, x0 fixed; factor k is between xk and the next."""
    ask(client, "admin/create", map=name)
    fixed = {"kind": "se2", "keys": ints("x0"), "values": floats(0, 0, 0), "fixed": True}
    free = {"kind": "se2", "keys": ints(*(f"x{k}" for k in range(1, poses)))}
    steps = [between(f"x{k}", f"x{k + 1}") for k in range(poses - 1)]
    assert insert(client, name, variables=[fixed, free], factors=steps)["revision"] == 1
    return name


def graph(client: Bare, name: str) -> bytes:
    came = client.ask(f"{HERE}/map/{name}/ask/graph")
    assert isinstance(came, bytes)
    return came


def refused(came: Any, code: str, **detail: Any) -> None:
    assert isinstance(came, Refused), came
    assert (came.code, {name: came.detail.get(name) for name in detail}) == (code, detail), came


@pytest.mark.parametrize("loss", LOSSES)
def test_why_of_an_outlier_has_r_its_weight_and_what_is_gained_without_it(client: Bare, loss: str) -> None:
    """A prior 4 m off, beside two that agree."""
    name, k = f"why-{loss}", 2.0
    ask(client, "admin/create", map=name)
    prior = {"kind": "prior_point2", "keys": ints("l1"), "information": floats(1, 0, 1)}
    far = prior | {"measured": floats(4, 0), "loss": loss, "scale": floats(k)}
    near = [prior | {"measured": floats(x, 0)} for x in (0.0, 0.1)]
    point = {"kind": "point2", "keys": ints("l1"), "values": floats(0, 0)}
    insert(client, name, variables=[point], factors=[*near, far], settle=True)
    rho = LOSSES[loss]
    best: Any = minimize_scalar(
        lambda x: x**2 + (x - 0.1) ** 2 + rho((x - 4) ** 2, k), bounds=(-1, 2), options={"xatol": 1e-9}
    )
    told = ask(client, f"map/{name}/ask/why", factor=2)["factor"]
    r = best.x - 4
    slope = (rho(r**2 + 1e-6, k) - rho(r**2 - 1e-6, k)) / 2e-6
    np.testing.assert_allclose(told["residual"], [r, 0], atol=1e-6)
    assert told["chi2"] == pytest.approx(r**2, rel=1e-6)
    assert told["rho"] == pytest.approx(rho(r**2, k), rel=1e-6)
    assert told["weight"] == pytest.approx(slope, abs=1e-6)
    assert told["without"] == pytest.approx(best.fun - 0.005, abs=1e-6)


FIRST = {
    "loss": {"factors": ints(1), "loss": "huber", "scale": floats(1)},
    "weigh": {"factors": ints(1), "weight": floats(2)},
    "fix": {"keys": ints("x1")},
    "free": {"keys": ints("x0")},
    "place": {"kind": "se2", "keys": ints("x1"), "values": floats(0, 0, 0)},
    "marginalize": {"keys": ints("x4")},
}


def test_marginalize_stands_behind_none_of_six_changes(client: Bare) -> None:
    name = chain(client, "order")
    before = graph(client, name)
    for change, fields in FIRST.items():
        changes = [{"change": change, **fields}, {"change": "marginalize", "keys": ints("x2")}]
        refused(insert(client, name, changes=changes), "bad_order", change="marginalize", next=2)
    assert graph(client, name) == before


def test_one_change_names_each_factor_and_each_variable_once(client: Bare) -> None:
    name = chain(client, "once")
    before = graph(client, name)
    of_factors = {
        "remove_factors": {},
        "weigh": {"weight": floats(2, 2)},
        "loss": {"loss": "dcs", "scale": floats(1, 1)},
    }
    for change, more in of_factors.items():
        twice = {"change": change, "factors": ints(1, 1), **more}
        refused(insert(client, name, changes=[twice]), "named_twice", factor=1, next=2)
    values = {"kind": "se2", "values": floats(*[0] * 6)}
    for change, more in {"fix": {}, "free": {}, "remove_variables": {}, "marginalize": {}, "place": values}.items():
        twice = {"change": change, "keys": ints("x1", "x1"), **more}
        refused(insert(client, name, changes=[twice]), "named_twice", key=key("x1"), next=2)
    refused(insert(client, name, changes=[{"change": "mend"}]), "unknown_kind", kind="mend", next=2)
    assert graph(client, name) == before


def test_the_least_weight_harms_no_insert_that_follows(client: Bare) -> None:
    name = chain(client, "weights")
    for weight in (1e-14, 9e-13, 2e12, float("nan")):
        changes = [{"change": "weigh", "factors": ints(1), "weight": floats(weight)}]
        refused(insert(client, name, changes=changes), "bad_weight", factor=1, next=2)
    insert(client, name, changes=[{"change": "weigh", "factors": ints(1), "weight": floats(1e-12)}])
    for number, start in enumerate(("x1", "x2", "x4"), 7):
        pose = {"kind": "se2", "keys": ints(f"x{number}")}
        assert insert(client, name, variables=[pose], factors=[between(start, f"x{number}")])["report"]["converged"]
    for least, taken in ((1e-25, False), (1e-24, True)):
        pose = {"kind": "se2", "keys": ints("x20")}
        weak = between("x2", "x20", information=floats(least, 0, 0, least, 0, least))
        came = insert(client, name, variables=[pose], factors=[weak])
        assert isinstance(came, dict) == taken, came
    pose = {"kind": "se2", "keys": ints("x21")}
    assert "revision" in insert(client, name, variables=[pose], factors=[between("x20", "x21")])


def test_keys_of_a_question_in_any_order_and_twice(client: Bare) -> None:
    name = chain(client, "keys")
    asked = ints("x3", "x1", "x3")
    (group,) = ask(client, f"map/{name}/ask/covariance", blocks="diagonal", keys=asked)["groups"]
    assert group["keys"] == asked
    (group,) = ask(client, f"map/{name}/ask/estimate", keys=asked)["variables"]
    assert group["keys"] == ints("x1", "x3")
    joint = ask(client, f"map/{name}/ask/covariance", blocks="joint", keys=asked)
    blocks = np.frombuffer(joint["covariance"], "<f8").reshape(3, 3, 3, 3)
    assert joint["keys"] == asked
    np.testing.assert_array_equal(blocks[0, :, 0], blocks[2, :, 2])
    fixed = ask(client, f"map/{name}/ask/covariance", blocks="joint", keys=ints("x0"))
    assert fixed["covariance"] == floats(*[0] * 9)


def test_parameters_are_skipped_refused_or_missed_by_the_code_the_page_names(client: Bare) -> None:
    name = chain(client, "parameters")
    to = f"map/{name}/ask"
    assert ask(client, f"{to}/chi2", colour="red")["revision"] == 1
    refused(ask(client, f"{to}/export", format="csv"), "bad_option", where="question.format")
    refused(ask(client, f"{to}/covariance", blocks="x"), "bad_option", where="question.blocks")
    refused(ask(client, f"{to}/associate", pose=1, kind="x", measured=b"", information=b""), "unknown_kind", kind="x")
    refused(ask(client, f"{to}/associate"), "bad_message", seen="missing")
    refused(ask(client, f"{to}/why"), "bad_message")
    refused(ask(client, f"{to}/why", key=key("x1"), factor=0), "bad_message")
    refused(ask(client, f"{to}/why", factor=99), "unknown_factor", factor=99)
    unknown = {"key": key("x99"), "keys": [key("x99")]}
    refused(ask(client, f"{to}/estimate", keys=ints("x99")), "unknown_variable", **unknown)
    refused(insert(client, name, factors=[between("x0", "x99")]), "unknown_variable", **unknown, next=2)
    refused(insert(client, name, factors=[between("x0", "x1", loss="soft", scale=floats(1))]), "bad_loss", next=2)
    refused(insert(client, name, factors=[between("x0", "x1", loss="huber")]), "bad_message", seen="missing", next=2)
    refused(insert(client, name, factors=[between("x0", "x1", ids=ints(1, 2))]), "bad_message", next=2)
    assert "revision" in insert(client, name, factors=[between("x0", "x1", ids=ints(-7))])


def test_a_quaternion_has_length_1_to_within_a_thousandth(client: Bare) -> None:
    ask(client, "admin/create", map="quaternions")
    for number, (length, taken) in enumerate(((1.0009, True), (0.9991, True), (1.0011, False), (0.9989, False))):
        pose = {"kind": "se3", "keys": ints(number), "values": floats(0, 0, 0, 0, 0, 0, length), "fixed": True}
        came = insert(client, "quaternions", variables=[pose])
        if taken:
            value = ask(client, "map/quaternions/ask/estimate", keys=ints(number))["variables"][0]["values"]
            np.testing.assert_allclose(np.frombuffer(value), [0, 0, 0, 0, 0, 0, 1], rtol=1e-15)
        else:
            refused(came, "bad_quaternion", next=2)


def test_of_a_map_key_that_comes_twice_the_last_counts(client: Bare) -> None:
    chain(client, "double")
    twice = b"\x82\xa8sequence\x05\xa8sequence\x01"
    assert sent(client, "map/double/in/twice", twice)["sequence"] == 1


def test_a_key_that_is_a_bin_names_no_field_and_any_other_that_is_no_string_is_refused(client: Bare) -> None:
    name, number = chain(client, "binary"), b"\xa8sequence\x01"
    assert sent(client, f"map/{name}/in/bin-1", b"\x82" + number + b"\xc4\x04what\x01")["sequence"] == 1
    refused(sent(client, f"map/{name}/in/bin-2", b"\x81\xc4\x08sequence\x01"), "bad_message", where="sequence", next=1)
    for place, key_of in enumerate((b"\x05", b"\xc0", b"\xc3", b"\xcb" + bytes(8), b"\x90")):
        came = sent(client, f"map/{name}/in/other-{place}", b"\x82" + number + key_of + b"\x01")
        refused(came, "bad_message", next=2)
    assert ask(client, f"map/{name}/ask/stats")["revision"] == 2


def test_the_second_run_of_a_name_gets_the_old_answer_to_the_same_bytes_and_else_bad_sequence(client: Bare) -> None:
    chain(client, "runs")
    first = packed({"sequence": 1})
    answer = client.ask(f"{HERE}/map/runs/in/robot", first)
    assert client.ask(f"{HERE}/map/runs/in/robot", first) == answer
    refused(ask(client, "map/runs/in/robot", sequence=1, settle=True), "bad_sequence", next=2)
    assert ask(client, "map/runs/ask/stats")["revision"] == 2


def test_numbers_that_no_client_waits_for(client: Bare) -> None:
    """`next` below the number, and nothing in flight: of a gap, and of a number that is too far ahead."""
    chain(client, "numbers")
    began = time.monotonic()
    refused(ask(client, "map/numbers/in/gap", sequence=3), "bad_sequence", next=1)
    assert time.monotonic() - began > 0.4, "limits.parked_s of this service is 0.5"
    refused(ask(client, "map/numbers/in/ahead", sequence=257), "bad_sequence", next=1)
    for number in (2**63, 0, -1, "1"):
        refused(ask(client, "map/numbers/in/gap", sequence=number), "bad_message", next=1)
    assert ask(client, "map/numbers/in/gap", sequence=1)["sequence"] == 1


BROKEN = {
    "a string that is not UTF-8": b"\xa2\xff\xfe",
    "an int as a key": b"\x81\x01\x02",
    "too deep": b"\x91" * 2000 + b"\xc0",
    "257 elements": msgpack.packb([0] * 257),
}


@pytest.mark.parametrize("what", BROKEN)
def test_what_is_broken_behind_its_number_uses_it_up(client: Bare, what: str) -> None:
    """In a field that nobody knows.  Who goes on with `next` is heard."""
    name = f"broken-{next(_number)}"
    chain(client, name)
    came = sent(client, f"map/{name}/in/a", b"\x82\xa8sequence\x01\xa3foo" + BROKEN[what])
    refused(came, "bad_message" if "y" in what or "UTF" in what else "too_large", next=2)
    assert ask(client, f"map/{name}/in/a", sequence=2)["sequence"] == 2


def test_a_fork_is_opened_and_other_operations_are_not_known(client: Bare) -> None:
    heard: list[str] = []
    subscriber = client.session.declare_subscriber(
        f"{HERE}/map/branch/out/event", lambda sample: heard.append(msgpack.unpackb(sample.payload.to_bytes())["event"])
    )
    chain(client, "trunk")
    row = ask(client, "admin/fork", map="trunk", **{"as": "branch", "request": 7})
    assert ask(client, "admin/fork", map="trunk", **{"as": "branch", "request": 7})["epoch"] == row["epoch"]
    refused(ask(client, "admin/fork", map="trunk", **{"as": "branch", "request": 8}), "map_exists", map="branch")
    refused(ask(client, "admin/drop", map="branch", revision=9), "moved_on", revision=1)
    refused(ask(client, "admin/drop", map="branch", damaged=True), "not_damaged")
    assert ask(client, "admin/drop", map="branch", revision=1) == {}
    end = time.monotonic() + 20
    while len(heard) < 2 and time.monotonic() < end:
        time.sleep(0.02)  # a publication tells nobody here that it has come
    assert heard == ["opened", "dropped"]
    subscriber.undeclare()
    refused(ask(client, "admin/weather"), "unknown_question")
    refused(ask(client, "map/trunk/ask/weather"), "unknown_question")


def test_the_length_of_q_changes_nothing_and_none_at_all_is_refused(client: Bare) -> None:
    service = ask(client, "admin/maps")["service"]
    camera = {"model": "pinhole", "numbers": floats(500, 500, 320, 240)}
    rest = {"camera": camera, "pixels": floats(300, 200), "rho": 0.5, "sigma_rho": 0.2, "sigma_pixel": 1.0}
    turned = np.array([0.9, 0.1, -0.3, 0.2])
    found = []
    for length in (1.0, 2.0):
        q = length * turned / np.linalg.norm(turned)
        P = np.diag([1.0, 1, 1, *[0.01 * length**2] * 4, *[1.0] * 6])
        state = floats(0, 0, 0, *q, *[0] * 6)
        came = ask(client, f"features/{service}/ask", state=state, covariance=floats(*P.ravel()), **rest)
        shard = msgpack.unpackb(came["shards"][0]["shard"])
        found.append((np.frombuffer(shard["y"]), np.frombuffer(shard["rows"]).reshape(6, 19)[:, 13:]))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-15)
    without = floats(*[0] * 13)
    refused(
        ask(client, f"features/{service}/ask", state=without, covariance=floats(*np.eye(13).ravel()), **rest),
        "bad_state",
    )
