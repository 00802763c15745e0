"""More of what the contract says, by a client written from it alone: numbers, orders and sizes that it had not said.

Each test is a row that such a client had found wrong, ambiguous or not said.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from bare import Bare, bare
from system.test_page_alone import HERE, ask, between, chain, floats, insert, ints, key, packed, refused, sent

from factorbus.formats import read
from factorbus.proto.problems import Refused
from factorbus.solver import Solver

VECTORS = Path(__file__).parents[2] / "proto" / "vectors"


@pytest.fixture(scope="module")
def client(endpoint: str) -> Iterator[Bare]:
    with bare(endpoint) as opened:
        yield opened


class Follower:
    """§7, step by step: the values of a map by key, as bytes."""

    def __init__(self, client: Bare, name: str) -> None:
        self._client, self._name, self._kept = client, name, list[dict[str, Any]]()
        self._subscriber = client.session.declare_subscriber(
            f"{HERE}/map/{name}/out/delta", lambda each: self._kept.append(msgpack.unpackb(each.payload.to_bytes()))
        )
        whole = ask(client, f"map/{name}/ask/estimate")
        self.epoch, self.revision, self.values = whole["epoch"], whole["revision"], rows(whole)
        self.whole = 0

    def reach(self, revision: int) -> None:
        end = time.monotonic() + 20
        while self.revision < revision and time.monotonic() < end:
            while self._kept:
                self._take(self._kept.pop(0))
            time.sleep(0.005)  # a publication tells nobody here that it has come
        assert self.revision >= revision

    def close(self) -> None:
        self._subscriber.undeclare()

    def _take(self, delta: dict[str, Any]) -> None:
        assert delta["epoch"] == self.epoch
        if delta["revision"] <= self.revision:
            return
        assert delta["previous"] in (0, self.revision), "a gap, where nothing was lost"
        self.whole += delta["previous"] == 0
        self.values = ({} if delta["previous"] == 0 else self.values) | rows(delta)
        self.revision = delta["revision"]


def rows(message: dict[str, Any]) -> dict[int, bytes]:
    found = {}
    for group in message["variables"]:
        keys = np.frombuffer(group["keys"], "<i8").tolist()
        size = len(group["values"]) // max(len(keys), 1)
        found |= {each: group["values"][n * size : (n + 1) * size] for n, each in enumerate(keys)}
    return found


def at_rest(client: Bare, name: str) -> dict[str, Any]:
    """What stats say when no further step is to come."""
    end = time.monotonic() + 20
    while (told := ask(client, f"map/{name}/ask/stats"))["converging"] and time.monotonic() < end:
        time.sleep(0.02)  # the last delta says so too, to who follows
    return told


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "inc-l-b10", "all-batch"])
def test_two_that_follow_have_the_estimate_bit_for_bit_and_a_report_its_chi2(client: Bare, mode: str) -> None:
    name = f"followed-{mode}"
    ask(client, "admin/create", map=name, mode=mode)
    first = Follower(client, name)
    chain(client, name, 9)
    second = Follower(client, name)
    loop = between("x7", "x0", measured=floats(-6.5, 0.5, -0.5))
    changes = [{"change": "weigh", "factors": ints(3), "weight": floats(2)}]
    gone = [{"change": "remove_variables", "keys": ints("x8")}]
    told = [
        insert(client, name, factors=[loop]), insert(client, name, changes=changes),
        insert(client, name, changes=gone), insert(client, name, factors=[between("x6", "x7")], settle=True),
    ]  # fmt: skip
    came = ask(client, f"map/{name}/ask/chi2")
    assert told[-1]["report"]["chi2"] == pytest.approx(came["chi2"], rel=1e-6), "it has settled"
    if came["revision"] == told[-1]["revision"]:
        assert told[-1]["report"]["chi2"] == pytest.approx(came["chi2"], rel=1e-12)
    assert told[0]["report"]["chi2_before"] > 2 * told[0]["report"]["chi2"] > 1.0
    revision = at_rest(client, name)["revision"]
    whole = ask(client, f"map/{name}/ask/estimate")
    for follower in (first, second):
        follower.reach(revision)
        assert (follower.revision, follower.values) == (whole["revision"], rows(whole))
        follower.close()
    assert first.whole > second.whole - 1 >= 0, "that of revision 1, and of what a step cannot make"
    assert key("x8") not in first.values


def test_the_exchange_byte_by_byte_is_that_of_a_service(client: Bare) -> None:
    """§5: the bytes of the page but for the epoch, which a service draws."""
    row = ask(client, "admin/create", map="kitchen", mode="all-batch")
    follower = Follower(client, "kitchen")
    message = msgpack.unpackb((VECTORS / "insert.msgpack").read_bytes())
    to = "map/kitchen/in/robot1-5f3a90c1"
    answer = sent(client, to, packed(message | {"epoch": row["epoch"]}))
    assert list(answer) == ["sequence", "epoch", "revision", "first_factor", "applied", "report"]
    assert (answer["sequence"], answer["revision"], answer["first_factor"], answer["applied"]) == (1, 1, 0, 1)
    assert (answer["report"]["mode"], answer["report"]["chi2"]) == ("all-batch", 0.0)
    follower.reach(1)
    assert follower.whole == 1
    assert follower.values == {key("x0"): floats(0, 0, 0), key("x1"): floats(1.5, 0.25, 0.125)}
    follower.close()
    indefinite = between("x0", "x1", information=floats(100, 200, 0, 100, 0, 400))
    refused(insert(client, "kitchen", factors=[indefinite]), "not_positive_definite", next=2)


@pytest.mark.parametrize("asked", ["auto", "bayes-tree", "inc-l", "inc-l-b10", "inc-l-b100", "all-batch"])
def test_of_auto_becomes_the_mode_that_the_row_says(client: Bare, asked: str) -> None:
    row = ask(client, "admin/create", map=f"mode-{asked}", mode=asked)
    assert row["mode"] == ("bayes-tree" if asked == "auto" else asked)
    assert ask(client, "admin/create", map=f"mode-{asked}", mode=row["mode"])["epoch"] == row["epoch"]
    other = "inc-l" if asked != "inc-l" else "all-batch"
    refused(ask(client, "admin/create", map=f"mode-{asked}", mode=other), "other_mode", mode=row["mode"])


def test_the_same_bytes_from_six_at_once_are_one_step_and_one_answer(client: Bare) -> None:
    name = chain(client, "six")
    message = packed({"sequence": 1, "factors": [between("x0", "x4", measured=floats(3.5, 0.7, 0.4))]})
    before = at_rest(client, name)
    waiting = [client.send(f"{HERE}/map/{name}/in/six-1", message) for _ in range(6)]
    answers = {each.get(timeout=60) for each in waiting}
    assert len(answers) == 1
    after = at_rest(client, name)
    assert after["factors"] == before["factors"] + 1
    assert after["inserts"]["accepted"] == before["inserts"]["accepted"] + 1


def test_of_a_window_the_last_number_is_parked_and_the_next_is_refused_at_once(client: Bare) -> None:
    name = chain(client, "window")
    took = []
    for number in (257, 256):  # n + 256 and n + 255, where 1 is wanted
        began = time.monotonic()
        refused(ask(client, f"map/{name}/in/far", sequence=number), "bad_sequence", next=1)
        took.append(time.monotonic() - began)
    assert took[1] > 0.4 > took[0], "limits.parked_s of this service is 0.5"


@pytest.mark.parametrize("count", [2000, 3000])
@pytest.mark.parametrize("blocks", ["joint", "cross"])
def test_sixteen_kilobytes_of_question_are_costed_before_they_are_answered(
    client: Bare, blocks: str, count: int
) -> None:
    name, many = f"costed-{blocks}-{count}", ints(*(["x1", "x2"] * (count // 2)))
    chain(client, name)
    more = {"others": many} if blocks == "cross" else {}
    came = ask(client, f"map/{name}/ask/covariance", blocks=blocks, keys=many, **more)
    refused(came, "too_large", limit=256 << 20)
    assert came.detail["size"] >= 8 * (3 * count) ** 2
    assert ask(client, f"map/{name}/ask/covariance", blocks="joint", keys=ints("x1"))["revision"] == 1


def test_arrays_are_counted_where_they_could_do_harm_and_groups_and_elements_always(client: Bare) -> None:
    name = chain(client, "arrays")
    small = {"foo": [[[]] * 250] * 80}  # 20,081 arrays and maps with the message itself
    assert "revision" in insert(client, name, **small)
    large = {"foo": [[[]] * 250] * 17, "bar": bytes(70_000)}
    refused(insert(client, name, **large), "too_large", limit=4096, next=2)
    group = {"kind": "se2", "keys": b""}
    refused(insert(client, name, variables=[group] * 257), "too_large", size=257, limit=256, next=2)
    assert "revision" in insert(client, name, variables=[group] * 256)


def test_what_is_put_or_deleted_at_the_key_of_inserts_has_no_effect(client: Bare) -> None:
    name = chain(client, "put")
    before, to = client.estimate(name), f"{HERE}/map/{name}/in/put"
    message = packed({"sequence": 1, "factors": [between("x0", "x4")]})
    client.session.put(to, message)
    client.session.delete(to)
    assert insert(client, name)["revision"] > 1, "what was sent before it has been read by now"
    assert ask(client, f"map/{name}/ask/stats")["factors"] == 4
    assert msgpack.unpackb(before)["variables"] == ask(client, f"map/{name}/ask/estimate")["variables"]
    assert sent(client, f"map/{name}/in/put", message)["sequence"] == 1, "its number is free"


def test_keys_in_the_other_order_of_bytes_are_other_keys(client: Bare) -> None:
    name = chain(client, "endian")
    swapped = np.array([key("x1")], ">i8").tobytes()
    pose = {"kind": "se2", "keys": swapped, "values": floats(1, 2, 0), "fixed": True}
    assert "revision" in insert(client, name, variables=[pose])
    other = int(np.frombuffer(swapped, "<i8")[0])
    assert rows(ask(client, f"map/{name}/ask/estimate"))[other] == floats(1, 2, 0)
    refused(insert(client, name, variables=[pose | {"keys": ints("x1")}]), "duplicate_variable", key=key("x1"), next=2)


def test_the_graph_tells_directions_of_length_1_and_the_limit_that_a_lens_has(client: Bare) -> None:
    """Of a pinhole, which has none, 10⁹, and of a fisheye π."""
    name, identity = "directions", floats(0, 0, 0, 0, 0, 0, 1)
    ask(client, "admin/create", map=name)
    poses = [{"kind": "se3", "keys": ints("y0"), "values": identity, "fixed": True}]
    poses += [{"kind": "se3", "keys": ints("y1"), "values": identity}]
    point = {"kind": "point3", "keys": ints("p1"), "values": floats(0, 0, 2)}
    six, three, two = (floats(*np.eye(n)[np.triu_indices(n)]) for n in (6, 3, 2))
    pixels = np.array([[320, 240, model, 500, 500, 320, 240, *[0] * 6] for model in (1, 2)], float)
    factors: list[dict[str, Any]] = [
        {"kind": "prior_se3", "keys": ints("y1"), "measured": identity, "information": six},
        {"kind": "attitude_se3", "keys": ints("y1"), "measured": floats(0, 0, 3, 0, 0, 5), "information": three},
        {"kind": "bearing_se3", "keys": ints("y0", "p1"), "measured": floats(0, 0, 9), "information": three},
        {"kind": "prior_point3", "keys": ints("p1"), "measured": floats(0, 0, 2), "information": three},
        {"kind": "point_seen", "keys": ints(*["y0", "p1"] * 2), "measured": pixels.tobytes(),
         "information": 2 * two},
    ]  # fmt: skip
    assert "revision" in insert(client, name, variables=[*poses, point], factors=factors)
    told = {g["kind"]: np.frombuffer(g["measured"]) for g in ask(client, f"map/{name}/ask/graph")["factors"]}
    assert told["attitude_se3"].tolist() == [0, 0, 1, 0, 0, 1]
    assert told["bearing_se3"].tolist() == [0, 0, 1]
    assert told["point_seen"].reshape(2, 13)[:, 7].tolist() == [1e9, np.pi]


def test_an_export_read_back_has_the_chi2_of_the_map_and_leaves_nothing_out_when_it_must_not(
    client: Bare, tmp_path: Path
) -> None:
    name = chain(client, "exported")
    insert(client, name, factors=[between("x4", "x0", measured=floats(-3.6, 0.9, -0.4))], settle=True)
    at_rest(client, name)
    export = ask(client, f"map/{name}/ask/export", format="g2o", strict=True)
    (tmp_path / "a.g2o").write_text(export["text"])
    assert export["notes"] == []
    batch, solver = read(tmp_path / "a.g2o").whole(), Solver()
    solver.stage(batch)
    solver.step()
    assert solver.chi2() == pytest.approx(ask(client, f"map/{name}/ask/chi2")["chi2"], rel=1e-12)
    assert "VERTEX_SE2 3 " in export["text"]
    assert "EDGE_SE2 2 3 " in export["text"]
    insert(client, name, factors=[between("x0", "x1", loss="huber", scale=floats(1))])
    assert any("huber" in note for note in ask(client, f"map/{name}/ask/export")["notes"])
    problem = ask(client, f"map/{name}/ask/export", strict=True)
    refused(problem, "bad_file")
    assert "loss" in problem.message
    times = [line.split()[0] for line in ask(client, f"map/{name}/ask/export", format="tum")["text"].splitlines()]
    assert times == ["0", "1", "2", "3", "4"], "of a robot without time stamps: the numbers of the keys"
    other = {"kind": "se2", "keys": ints("y7"), "values": floats(0, 0, 0), "fixed": True}
    insert(client, name, variables=[other])
    refused(ask(client, f"map/{name}/ask/export", format="tum"), "several_robots", robots=["x", "y"])
    assert ask(client, f"map/{name}/ask/export", format="tum", robot="y")["text"].startswith("7 ")


def test_what_marginalize_left_goes_into_another_map_as_it_is_told(client: Bare) -> None:
    name = chain(client, "marginal", 7)
    insert(client, name, factors=[between("x6", "x0", measured=floats(-5.5, 1.5, -0.6))], settle=True)
    kept = ints("x2", "x5", "x6")
    before = ask(client, f"map/{name}/ask/covariance", blocks="joint", keys=kept)
    came = insert(client, name, changes=[{"change": "marginalize", "keys": ints("x1", "x3", "x4")}])
    assert came["report"]["removed_variables"] == 3
    graph = ask(client, f"map/{name}/ask/graph")
    assert any(group["kind"].startswith("linear_") for group in graph["factors"])
    ask(client, "admin/create", map="copy")
    told = {field: graph[field] for field in ("variables", "factors")}
    assert "revision" in insert(client, "copy", **told, settle=True)
    for there in (name, "copy"):
        joint = ask(client, f"map/{there}/ask/covariance", blocks="joint", keys=kept)
        ours, theirs = (np.frombuffer(each["covariance"]) for each in (joint, before))
        np.testing.assert_allclose(ours, theirs, rtol=5e-8, atol=5e-10)


def test_a_refusal_in_one_insert_of_a_kind_or_loss_that_came_later_changes_nothing(client: Bare) -> None:
    """§13: fields and questions are passed over or said to be unknown, kinds and losses are refused."""
    name = chain(client, "newer")
    before = client.estimate(name)
    assert isinstance(before, bytes)
    later = [
        (between("x0", "x1") | {"kind": "between_se9"}, "unknown_kind"),
        (between("x0", "x1") | {"loss": "barron", "scale": floats(1)}, "bad_loss"),
    ]
    for factor, code in later:
        came = insert(client, name, factors=[factor])
        assert isinstance(came, Refused)
        assert (came.code, came.detail["next"]) == (code, 2)
    assert client.estimate(name) == before
    assert "revision" in insert(client, name, factors=[between("x0", "x1") | {"later": [1, {"a": b"b"}]}], later=7)


def one(kind: str, keys: bytes, measured: bytes, dim: int) -> dict[str, Any]:
    """A factor of unit information."""
    return {"kind": kind, "keys": keys, "measured": measured, "information": floats(*np.eye(dim)[np.triu_indices(dim)])}


LENS = [1, 500, 500, 320, 240, *[0] * 6]
CONTENT = {
    "bad_range": one("range_se2", ints("x0", "p0"), floats(-1), 1),
    "bad_direction": one("bearing_se3", ints("y0", "q0"), floats(0, 0, 0), 3),
    "bad_lens": one("point_seen", ints("y0", "q0"), floats(320, 240, 1, 0, *LENS[2:]), 2),
    "bad_observation": one("point_seen", ints("y0", "q1"), floats(320, 240, *LENS), 2),
}


@pytest.mark.parametrize("code", CONTENT)
def test_what_is_wrong_with_a_measurement_has_its_code_and_says_where(client: Bare, code: str) -> None:
    name = f"content-{code.replace('_', '-')}"
    ask(client, "admin/create", map=name)
    held = [
        {"kind": "se2", "keys": ints("x0"), "values": floats(0, 0, 0), "fixed": True},
        {"kind": "se3", "keys": ints("y0"), "values": floats(0, 0, 0, 0, 0, 0, 1), "fixed": True},
        {"kind": "point2", "keys": ints("p0"), "values": floats(1, 0), "fixed": True},
        {"kind": "point3", "keys": ints("q0", "q1"), "values": floats(0, 0, 2, 0, 0, -2), "fixed": True},
    ]
    assert "revision" in insert(client, name, variables=held)
    before = client.estimate(name)
    came = insert(client, name, factors=[CONTENT[code]])
    refused(came, code, next=2)
    assert isinstance(came.detail["where"], str)
    assert client.estimate(name) == before


def test_a_question_for_features_names_a_camera_that_cannot_be(client: Bare) -> None:
    service = ask(client, "admin/maps")["service"]
    state, covariance = floats(0, 0, 0, 1, *[0] * 9), floats(*np.eye(13).ravel())
    rest = {"pixels": floats(300, 200), "rho": 0.5, "sigma_rho": 0.2, "sigma_pixel": 1.0}
    asked = {"state": state, "covariance": covariance, **rest}
    for model, numbers in (("pinhole", floats(0, 500, 320, 240)), ("pinhole", floats(500)), ("periscope", b"")):
        camera = {"model": model, "numbers": numbers}
        came = ask(client, f"features/{service}/ask", camera=camera, **asked)
        assert isinstance(came, Refused)
        assert came.code in ("bad_camera", "bad_message"), came
    refused(ask(client, f"features/{service}/ask", camera=camera, **asked), "bad_camera")


def test_what_shares_factors_with_too_much_is_not_marginalized(client: Bare) -> None:
    ask(client, "admin/create", map="hub")
    points = ints(*(f"p{n}" for n in range(129)))
    hub = {"kind": "se2", "keys": ints("x0"), "values": floats(0, 0, 0)}
    seen = ints(*(each for n in range(129) for each in ("x0", f"p{n}")))
    factors = [
        one("prior_se2", ints("x0"), floats(0, 0, 0), 3),
        {"kind": "landmark_se2", "keys": seen, "measured": floats(*[1, 1] * 129),
         "information": floats(*[1, 0, 1] * 129)},
    ]  # fmt: skip
    assert "revision" in insert(client, "hub", variables=[hub, {"kind": "point2", "keys": points}], factors=factors)
    came = insert(client, "hub", changes=[{"change": "marginalize", "keys": ints("x0")}])
    refused(came, "too_connected", next=2)
    assert sorted(came.detail["separator"]) == sorted(np.frombuffer(points, "<i8").tolist())
