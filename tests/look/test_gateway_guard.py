"""Who may edit through the gateway, and what of a body, a header or a list of people is refused."""

import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gateways import Editor, problem_of, square
from processes import Process, processes
from secured import Secured
from walk import blocks

from factorbus.cli.main import main
from factorbus.cli.output.exits import USAGE
from factorbus.client import connect
from factorbus.client.frames import compose, inverse
from factorbus.proto.messages import Variables
from factorbus.proto.problems import Problem
from factorbus.proto.symbols import symbol

pytest.importorskip("starlette")

from factorbus.gateway.merge_plans import frame_of_pairs, free_letters
from factorbus.gateway.people import BadPeople, NotAllowed, Person, read_people

ANN, WALL = "the-token-of-an-operator", "the-token-of-a-viewer"
PEOPLE = f'[operator]\nann = "{ANN}"\n[viewer]\nwall = "{WALL}"\n'
NOBODY = Person("local", "viewer", "sign in")
FIX = b'{"edit": "fix", "keys": ["x3"]}'


@pytest.fixture(scope="module")
def gateway(endpoint: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """One with a list of people, at a map `guarded`."""
    folder = tmp_path_factory.mktemp("gateway")
    (folder / "people.toml").write_text(PEOPLE)
    with processes(folder) as start, connect(endpoint, client="robot", timeout_s=60) as bus:
        with bus.map("guarded") as joined:
            joined.insert(square())
        asked = ("--connect", endpoint, "--port", "0", "--people", str(folder / "people.toml"))
        yield start("-m", "factorbus.cli", "gateway", *asked).ready()[0]


def refused(act: Callable[[], Any]) -> dict[str, Any]:
    with pytest.raises(urllib.error.HTTPError) as raised:
        act()
    return problem_of(raised.value)


def test_a_viewer_looks_and_an_operator_edits(gateway: str) -> None:
    for token, name in ((WALL, "wall"), ("", "local")):
        viewer = Editor(gateway, "guarded", token)
        session = viewer.ask("session")
        assert (session["name"], session["role"], session["may_edit"]) == (name, "viewer", False)
        assert session["why"]
        problem = refused(lambda viewer=viewer: viewer.edit("fix", keys=["x3"]))
        assert (problem["status"], problem["code"]) == (403, "not_allowed")
        assert session["why"] in problem["message"]
        assert viewer.ask("edges")["fixed"] == ["x0"], "looking is free"
    unknown = refused(lambda: Editor(gateway, "guarded", "some-other-token-altogether").ask("session"))
    assert (unknown["status"], unknown["code"]) == (403, "not_allowed")
    operator = Editor(gateway, "guarded", ANN)
    assert operator.ask("session")["may_edit"] is True
    assert operator.edit("fix", keys=["x3"])["who"] == "ann"
    operator.edit("undo", number=1)


@pytest.mark.parametrize(
    "headers",
    [
        {"X_Factorbus_Token": ""},
        {"X_Factorbus_Token": "a-guess"},
        {"X_Factorbus_Token": "\xe9"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://["},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
        {"Authorization": "Basic " + ANN},
    ],
)
def test_an_edit_that_a_page_from_elsewhere_could_send_is_refused(gateway: str, headers: dict[str, str]) -> None:
    editor = Editor(gateway, "guarded", ANN)
    problem = refused(lambda: editor.post(FIX, **headers))
    assert (problem["status"], problem["code"]) == (403, "not_allowed")
    assert editor.ask("edges")["fixed"] == ["x0"]


def test_what_a_form_can_send_is_no_edit_and_pages_of_others_do_not_read_the_token(gateway: str) -> None:
    editor = Editor(gateway, "guarded", ANN)
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"):
        assert refused(lambda kind=kind: editor.post(FIX, Content_Type=kind))["code"] == "bad_message"
    assert editor.ask("edges")["fixed"] == ["x0"]
    asked = urllib.request.Request(f"{editor.root}/session", headers={"Origin": "http://evil.example"})
    with urllib.request.urlopen(asked, timeout=60) as answer:
        assert not [name for name in answer.headers if name.lower().startswith("access-control")]
    asked = urllib.request.Request(f"{editor.root}/edits", method="OPTIONS", headers={"Origin": "http://evil.example"})
    assert refused(lambda: urllib.request.urlopen(asked, timeout=60))["status"] == 405
    with urllib.request.urlopen(gateway, timeout=60) as page:
        assert "frame-ancestors 'none'" in page.headers["Content-Security-Policy"]
        assert page.headers["X-Frame-Options"] == "DENY"


MALFORMED = [
    (b"", "bad_message"),
    (b"\xff\xfe", "bad_message"),
    (b"{", "bad_message"),
    (b"[]", "bad_message"),
    (b"null", "bad_message"),
    (b"[" * 100_000, "bad_message"),
    (b'{"edit": "weigh", "factors": [1], "weight": NaN}', "bad_message"),
    (b'{"edit": "weigh", "factors": [1], "weight": 1e999}', "bad_option"),
    (b'{"edit": "weigh", "factors": [1], "weight": ' + b"9" * 400 + b"}", "bad_option"),
    (b"{}", "bad_option"),
    (b'{"edit": ["reject"]}', "bad_option"),
    (b'{"edit": "drop"}', "bad_option"),
    (b'{"edit": "reject"}', "bad_option"),
    (b'{"edit": "reject", "factors": [true]}', "bad_option"),
    (b'{"edit": "reject", "factors": [1.0]}', "bad_option"),
    (b'{"edit": "reject", "factors": [-1]}', "bad_option"),
    (b'{"edit": "reject", "factors": []}', "bad_option"),
    (b'{"edit": "reject", "factors": [1], "all": true}', "bad_option"),
    (b'{"edit": "fix", "keys": [3]}', "bad_option"),
    (b'{"edit": "fix", "keys": ["3x"]}', "bad_symbol"),
    (b'{"edit": "merge", "other": "../x", "pairs": [["x1", "x2"]], "sigmas": [1]}', "bad_option"),
    (b'{"edit": "merge", "other": "y", "pairs": [["x1"]], "sigmas": [1]}', "bad_option"),
    (b'{"edit": "merge", "other": "y", "pairs": [["x1", "x2"]], "sigmas": [0]}', "bad_option"),
    (b'{"edit": "undo", "number": "1"}', "bad_option"),
]


@pytest.mark.parametrize(("body", "code"), MALFORMED)
def test_a_malformed_body_is_named(gateway: str, body: bytes, code: str) -> None:
    problem = refused(lambda: Editor(gateway, "guarded", ANN).post(body))
    assert (problem["status"], problem["code"]) == (400, code)


def test_a_body_beyond_its_limit_and_a_map_that_is_not_there(gateway: str) -> None:
    assert refused(lambda: Editor(gateway, "guarded", ANN).post(b" " * (1 << 21)))["code"] == "too_large"
    nowhere = Editor(gateway, "guarded", ANN)
    token = nowhere.ask("session")["token"]
    nowhere.root = nowhere.root.replace("guarded", "nowhere")
    headers = {"Content-Type": "application/json", "X-Factorbus-Token": token, "Authorization": f"Bearer {ANN}"}
    asked = urllib.request.Request(f"{nowhere.root}/edits", FIX, headers)
    problem = refused(lambda: urllib.request.urlopen(asked, timeout=60))
    assert (problem["status"], problem["code"]) == (404, "unknown_map")
    assert refused(lambda: Editor(gateway, "guarded").ask("factors/1e3"))["code"] == "bad_option"
    assert refused(lambda: Editor(gateway, "guarded").ask("factors/9999"))["code"] == "unknown_factor"


def test_who_may_only_look_on_the_bus_cannot_edit_here(tmp_path: Path, spawn: Callable[..., Process]) -> None:
    """Access control drops what it denies without a word: the gateway finds out, and says so."""
    secured = Secured(tmp_path)
    service = ("-m", "factorbus.service", "--listen", "tls/127.0.0.1:0", "--zenoh", str(secured.server), "--name", "s1")
    (endpoint,) = spawn(*service, "--create", "kitchen").ready()
    addresses = {}
    for name in ("wall", "robot1"):
        asked = ("--connect", endpoint, "--zenoh", str(secured.clients[name]), "--client", name, "--port", "0")
        (addresses[name],) = spawn("-m", "factorbus.cli", "gateway", *asked).ready()
    with connect(endpoint, client="robot1", zenoh=secured.clients["robot1"], timeout_s=60) as bus:
        with bus.map("kitchen", create=False) as joined:
            joined.insert(square())
        assert bus.may_insert("kitchen")
    wall = Editor(addresses["wall"], "kitchen")
    session = wall.ask("session")
    assert (session["role"], session["may_edit"]) == ("operator", False)
    assert "access control on the bus" in session["why"]
    assert refused(lambda: wall.edit("fix", keys=["x3"]))["code"] == "not_allowed"
    assert Editor(addresses["robot1"], "kitchen").edit("fix", keys=["x3"])["who"] == "local"
    assert wall.ask("edges")["fixed"] == ["x0", "x3"]


@pytest.mark.parametrize(
    "text",
    [
        "[operator", "[robot]\nann = 'a-long-enough-token'", "operator = 1", "[operator]\nann = 1",
        "[operator]\nann = 'short'",
        "[operator]\n'a b' = 'a-long-enough-token'", "[operator]\nlocal = 'a-long-enough-token'",
        "[operator]\nann = 'a-long-enough-token'\n[viewer]\nbob = 'a-long-enough-token'",
        "[operator]\nann = 'a-long-enough-token'\n[viewer]\nann = 'another-long-token'",
        "[operator]\nann = 'a-long-enough-t\u00f6ken'",
    ],
)  # fmt: skip
def test_a_list_of_people_that_cannot_be_is_refused(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(BadPeople) as raised:
        read_people(text, "people.toml", NOBODY)
    assert "a-long-enough" not in str(raised.value), "a token is not shown"
    (tmp_path / "people.toml").write_text(text, encoding="utf-8")
    assert main(["gateway", "--people", str(tmp_path / "people.toml")]) == USAGE
    assert "[bad_people]" in capsys.readouterr().err


def test_people_are_told_apart_by_their_tokens() -> None:
    people = read_people(PEOPLE, "people.toml", NOBODY)
    assert people.of(None) is NOBODY
    assert (people.of(f"Bearer {ANN}").name, people.of(f"bearer  {WALL} ").role) == ("ann", "viewer")
    for wrong in ("", ANN, f"Basic {ANN}", "Bearer", f"Bearer {ANN[:-1]}", "Bearer \u00e9\udcff"):
        with pytest.raises(NotAllowed):
            people.of(wrong)


def test_the_list_in_the_guide_is_one() -> None:
    (text,) = [text for language, text in blocks("clients/README.md") if language == "toml"]
    people = read_people(text, "clients/README.md", NOBODY)
    assert [(person.name, person.role) for person in people.listed] == [("ann", "operator"), ("wall", "viewer")]


def test_pairs_say_how_a_map_lies_in_another() -> None:
    """Of places alone; to the bit of rounding, in the plane and in space, also where a quaternion's w is nothing."""
    numbers = np.random.default_rng(5)
    for size, turn in ((3, 2.5), (7, None), (7, np.array([1.0, 0, 0, 0])), (7, np.array([0.0, 0.8, 0.6, 0]))):
        if size == 3:
            frame = np.array([1.0, -2.0, turn])
            there = numbers.normal(size=(5, 3))
        else:
            quaternion = numbers.normal(size=4) if turn is None else turn
            frame = np.concatenate([[1.0, -2.0, 3.0], quaternion / np.linalg.norm(quaternion)])
            there = np.column_stack([numbers.normal(size=(5, 3)), np.tile([0, 0, 0, 1.0], (5, 1))])
        for count in (1, 2 if size == 3 else 3, 5):  # of the fewest that say it, a mirror image fits as well
            found = frame_of_pairs(compose(frame, there)[:count], there[:count])
            left = compose(inverse(frame), found[None])[0]
            np.testing.assert_allclose(np.abs(left), [0.0] * 3 if size == 3 else [0.0] * 6 + [1.0], atol=1e-9)
    line = np.column_stack([np.arange(3.0), np.zeros((3, 5)), np.ones(3)])
    for here, same in ((line, line), (np.zeros((2, 3)), np.zeros((2, 3)))):
        with pytest.raises(Problem) as raised:
            frame_of_pairs(here, same)
        assert raised.value.code == "cannot_merge"


def test_letters_that_both_maps_have_are_given_free_ones() -> None:
    def of(letters: str) -> list[Variables]:
        return [Variables("se2", np.array([symbol(letter.strip(), 1) for letter in letters]))]

    assert free_letters(of("xl"), of("xya")) == {"x": "b"}
    assert free_letters(of("x "), of("y ")) == {"": "a"}
    assert free_letters(of("x"), of("y")) == {}
