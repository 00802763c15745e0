"""`factorbus gateway`: what HTTP says is what the map has, and the page works in a real browser."""

import json
import signal
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import free_port, needs_browser, page_of, picture_of, share_of
from processes import Process
from turned import closing, in_one

from factorbus.cli.main import main
from factorbus.cli.output.exits import OK, UNAVAILABLE, USAGE
from factorbus.cli.process import bus as way_to_bus
from factorbus.client import Draft, connect
from factorbus.proto.messages import Delta, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import format_symbol
from factorbus.simulate import city_trees, manhattan
from factorbus.viz import style

pytest.importorskip("starlette")

from factorbus.gateway.live import _together

T0 = 1_403_636_579_763_555_584


@pytest.fixture
def gateway(endpoint: str, spawn: Callable[..., Process]) -> str:
    """The address of one."""
    (address,) = spawn("-m", "factorbus.cli", "gateway", "--connect", endpoint, "--port", "0").ready()
    return address


def get(address: str, **headers: str) -> Any:
    with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=60) as answer:
        content = answer.read().decode()
        return json.loads(content) if answer.headers["Content-Type"].startswith("application/json") else content


def refusal(address: str, **headers: str) -> tuple[int, str]:
    with pytest.raises(urllib.error.HTTPError) as raised:
        get(address, **headers)
    with raised.value as answer:
        text = answer.read().decode()
    return raised.value.code, json.loads(text)["problem"]["code"] if text.startswith("{") else text


def test_what_http_says_is_what_the_map_has(endpoint: str, gateway: str) -> None:
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("asked") as joined:
        for n, step in enumerate(city_trees(poses=80, seed=3)):
            pose, *others = step.batch.variables
            joined.insert(step.batch._replace(variables=(pose._replace(stamps=np.array([T0 + n])), *others)))
        joined.wait_converged(60)
        snapshot, graph = joined.estimate.snapshot(), joined.graph().batch
        root = f"{gateway}/api/maps/asked"
        assert "asked" in [row["name"] for row in get(f"{gateway}/api/maps")["maps"]]
        found = get(f"{root}/estimate")
        assert (found["revision"], found["epoch"]) == (snapshot.revision, str(snapshot.epoch))
        for group in found["variables"]:
            keys, values = snapshot.columns[group["kind"]]
            assert group["keys"] == [format_symbol(key) for key in keys.tolist()]
            np.testing.assert_array_equal(group["values"], values)
            times = [str(T0 + n) for n in range(80)] if group["kind"] == "se2" else None
            assert group.get("stamps") == times, "as text, which JavaScript does not round"
        assert sum(len(group["keys"]) for group in get(f"{root}/graph")["factors"]) == graph.factor_count
        assert get(f"{root}/stats")["factors"] == graph.factor_count
        for form in ("kitti", "pyfg", "jrl"):
            assert get(f"{root}/export?format={form}") == joined.export(form)
        # Each factor is counted with each of its variables: the sum over variables is arity times χ².
        explained = [
            get(f"{root}/variables/{format_symbol(key)}")
            for keys, _ in snapshot.columns.values()
            for key in keys.tolist()
        ]
        assert sum(each["chi2"] for each in explained) == pytest.approx(2 * joined.chi2().chi2, rel=1e-9)
        # What is said of certainty is what the map says when it is asked itself.
        covariances = joined.uncertainty.covariance()
        for each in explained:
            np.testing.assert_allclose(
                each["sigmas"], np.sqrt(np.diag(covariances[each["key"]])), rtol=1e-9, atol=1e-15
            )
        spread = get(f"{root}/ellipses")
        assert spread["revision"] == snapshot.revision
        xx, xy, xz, yy, yz, zz = np.transpose(spread["covariances"])
        assert not np.any([xz, yz, zz])
        for key, *local in zip(spread["keys"], xx + yy, xx * yy - xy * xy, strict=True):
            block = covariances[key][:2, :2]  # turned into the map: the same trace and determinant
            np.testing.assert_allclose(local, [np.trace(block), np.linalg.det(block)], rtol=1e-9, atol=1e-15)


def test_time_stamps_come_with_what_is_sent_live() -> None:
    """Deltas of which a browser is told at once: the last value of each, and the stamp whenever it came."""

    def delta(revision: int, keys: list[int], stamps: list[int] | None) -> Delta:
        column = None if stamps is None else np.array(stamps)
        group = Variables("point2", np.array(keys), np.full((len(keys), 2), float(revision)), False, column)
        return Delta(1, revision, revision - 1, (group,))

    (group,) = _together([delta(5, [1, 2], [-T0, NO_STAMP]), delta(6, [1, 3], None)])["variables"]
    assert group == {
        "kind": "point2",
        "keys": ["1", "2", "3"],
        "values": [[6.0, 6.0], [5.0, 5.0], [6.0, 6.0]],
        "stamps": [str(-T0), None, None],
    }
    (group,) = _together([delta(6, [1], None)])["variables"]
    assert "stamps" not in group


def test_a_contradiction_is_named(endpoint: str, gateway: str) -> None:
    """A wrong loop closure among good odometry: the variable's page says which factor misses."""
    draft = Draft().se2("x0", (0, 0, 0), fixed=True)
    for i in range(4):
        draft.se2(f"x{i + 1}").between_se2(f"x{i}", f"x{i + 1}", (1.0, 0, 0), sigmas=(0.1, 0.1, 0.05))
    draft.between_se2("x0", "x4", (2.0, 0, 0), sigmas=(0.3, 0.3, 0.1))
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("wrong") as joined:
        joined.insert(draft, settle=True)
        joined_chi2 = joined.chi2().chi2
    said = get(f"{gateway}/api/maps/wrong/variables/x4")
    assert said["factors"][0]["keys"] == ["x0", "x4"]
    assert "between_se2 (x0, x4) contradicts the rest" in said["text"]
    assert "without it χ² would fall by about" in said["text"]
    loop, odometry = said["factors"]
    assert 0 < loop["known"] < 0.5 < odometry["known"] < 1
    assert loop["without"] == pytest.approx(joined_chi2, rel=1e-6), "odometry alone contradicts nothing"
    assert "fixed" in get(f"{gateway}/api/maps/wrong/variables/x0")["text"]


def test_problems_have_their_codes(endpoint: str, gateway: str) -> None:
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("small") as joined:
        joined.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
    root = f"{gateway}/api/maps"
    assert refusal(f"{root}/nowhere/estimate") == (404, "unknown_map")
    assert refusal(f"{root}/not%20a%20name/estimate")[1] in ("bad_name", "unknown_map")
    assert refusal(f"{root}/small/variables/x9") == (404, "unknown_variable")
    for address in (f"{root}/small", f"{root}/small/nothing", f"{gateway}/api/nothing"):
        assert refusal(address) == (404, "unknown_question")
    with pytest.raises(urllib.error.HTTPError) as missing:
        get(f"{root}/small/variables/x9")
    with missing.value as answer:
        detail = json.load(answer)["problem"]["detail"]
    assert (detail["key"], detail["keys"]) == ("x9", ["x9"]), "as text, which JavaScript does not round"
    assert refusal(f"{gateway}/nothing")[1] == "Not Found"
    assert refusal(f"{root}/small/variables/12x") == (400, "bad_symbol")
    assert refusal(f"{root}/small/export?format=png") == (400, "bad_option")
    assert refusal(f"{root}/small/estimate", Host="evil.example")[0] == 400


@pytest.mark.parametrize("command", [["gateway"], ["watch", "town", "--serve"]])
def test_other_machines_are_served_only_if_one_says_so(
    command: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(way_to_bus, "_LISTENING_S", 0.0)  # that nobody is there is said at the first refusal
    for host in ("0.0.0.0", "::", "192.168.1.20", "robot.local"):
        assert main([*command, "--connect", "tcp/127.0.0.1:1", "--host", host]) == USAGE
        assert "[exposed]" in capsys.readouterr().err
        assert main([*command, "--connect", "tcp/127.0.0.1:1", "--host", host, "--insecure"]) == UNAVAILABLE
    for host in ("127.0.0.1", "127.0.0.5", "localhost", "::1"):
        assert main([*command, "--connect", "tcp/127.0.0.1:1", "--host", host]) == UNAVAILABLE


def test_a_page_from_elsewhere_gets_no_map(endpoint: str, gateway: str) -> None:
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect as dial

    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("guarded") as joined:
        joined.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
    live = f"{gateway.replace('http', 'ws')}/api/maps/guarded/live"
    with dial(live, origin="http://evil.example") as socket, pytest.raises(ConnectionClosed) as closed:  # type: ignore[arg-type]
        socket.recv(timeout=60)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 4403
    with dial(live) as socket:
        assert json.loads(socket.recv(timeout=60))["variables"][0]["keys"] == ["x0"]


def test_a_slow_browser_misses_no_value(endpoint: str, gateway: str) -> None:
    """Everything that a WebSocket sends, applied in order, is the estimate, bit for bit."""
    from websockets.sync.client import connect as dial

    steps = list(manhattan(poses=150, seed=4))
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("streamed") as joined:
        for step in steps[:30]:
            joined.insert(step.batch)
        with dial(f"{gateway.replace('http', 'ws')}/api/maps/streamed/live", max_size=None) as socket:
            for step in steps[30:]:
                joined.insert(step.batch)
            values, revision = {}, 0
            while revision < joined.estimate.revision:
                message = json.loads(socket.recv(timeout=60))
                assert message["type"] == "estimate" or message["previous"] == revision
                revision = message["revision"]
                for group in message["variables"]:
                    values |= dict(zip(group["keys"], group["values"], strict=True))
        keys, wanted = joined.estimate.columns("se2")
        assert values == dict(zip(map(format_symbol, keys.tolist()), wanted.tolist(), strict=True))


@needs_browser
def test_the_page_in_a_browser(endpoint: str, gateway: str, tmp_path: Path) -> None:
    """It loads, poses move, and a variable that is clicked is explained."""
    steps = list(city_trees(poses=120, seed=2))
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("town") as joined:
        for step in steps[:60]:
            joined.insert(step.batch)
        with page_of(f"{gateway}/#town") as page:
            failures: list[str] = []
            page.on("pageerror", lambda error: failures.append(str(error)))
            page.wait_for_function("window.factorbus.revision >= 60", timeout=60_000)
            before, where = picture_of(page), page.evaluate("window.factorbus.placeOf('x40')")
            for step in steps[60:]:
                joined.insert(step.batch)
            joined.settle()
            page.wait_for_function(f"window.factorbus.revision === {joined.estimate.revision}", timeout=60_000)
            assert page.evaluate("window.factorbus.placeOf('x40')")[:2] == joined.estimate["x40"][:2].tolist()
            assert where != page.evaluate("window.factorbus.placeOf('x40')")
            for what in ("closures", "ellipses"):
                page.wait_for_function(
                    f"window.factorbus.{what}.revision === {joined.estimate.revision}", timeout=60_000
                )
            after = picture_of(page)
            assert (before != after).any(axis=2).mean() > 0.005
            assert share_of(after, style.ESTIMATE) > 3e-4
            assert share_of(after, style.POINTS) > 5e-5
            assert share_of(after, style.UNCERTAINTY) > 5e-5
            x, y = page.evaluate("window.factorbus.pixelOf('x40')")
            box = page.locator("#map").bounding_box()
            page.mouse.click(box["x"] + x, box["y"] + y)
            page.wait_for_selector("#panel h2")
            name = page.inner_text("#panel h2")
            assert np.hypot(*(joined.estimate[name][:2] - joined.estimate["x40"][:2])) < 1.0
            panel = page.inner_text("#panel")
            assert f"{name} is a pose in the plane, held by" in panel
            assert "Its place is known to" in panel
            assert "last step of the map: batch: asked to settle" in panel
            factors = sum(int((g.keys == keys_of(name)).any(axis=1).sum()) for g in joined.graph().batch.factors)
            assert page.locator("#panel tr").count() == factors + 1
            page.screenshot(path=tmp_path / "page.png")  # for a person to look at
            assert failures == []


@needs_browser
def test_the_page_says_while_a_map_is_converging(endpoint: str, gateway: str) -> None:
    # A page that draws slowly leaves revisions out, so it may miss one drive's; it does not miss all of them.
    assert any(_said_converging(endpoint, gateway, f"turned-{n}") for n in range(5))


def _said_converging(endpoint: str, gateway: str, name: str) -> bool:
    """Whether the page said so before the map had converged; it does not afterwards."""
    poses = 1000
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map(name, "all-batch") as joined:
        joined.insert(in_one(poses, 90.0))
        with page_of(f"{gateway}/#{name}") as page:
            page.wait_for_function(f"window.factorbus.revision >= {joined.estimate.revision}", timeout=60_000)
            said = "document.getElementById('state').textContent"
            page.evaluate(
                f"window.seen = []; new MutationObserver(() => window.seen.push({said}))"
                ".observe(document.getElementById('state'), {childList: true})"
            )
            joined.insert(closing(poses))
            joined.wait_converged(60)
            page.wait_for_function(f"window.factorbus.revision === {joined.estimate.revision}", timeout=60_000)
            *before, last = page.evaluate("window.seen")
            assert "converging" not in last
            return any(text.endswith(" · converging") for text in before)


@needs_browser
def test_a_file_of_ones_own_is_seen_live_by_one_command(spawn: Callable[..., Process], tmp_path: Path) -> None:
    """`make live`: solver, page and robot; when the drive is over the page stays until Ctrl-C."""
    path = tmp_path / "mine.g2o"
    assert main(["simulate", "manhattan", "--poses", "80", "--out", str(path)]) == OK
    process = spawn(
        "-m", "factorbus.cli", "replay", str(path), "--live", "--port", "0", "--map", "mine", "--pace", "60"
    )
    address = process.said("the map, live: ")
    with page_of(address) as page:
        page.wait_for_function("window.factorbus.revision > 5", timeout=60_000)
        # By its last pose: a drive that pauses, for a machine that is busy, has further steps in between.
        page.wait_for_function("window.factorbus.placeOf('x79')", timeout=60_000)
        process.said("the page stays until Ctrl-C")
    process.signal(signal.SIGINT)
    assert process.wait() == OK


def keys_of(name: str) -> int:
    from factorbus.proto.symbols import parse_symbol

    return parse_symbol(name)


def test_it_stops_with_browsers_connected_and_says_when_a_port_is_taken(
    endpoint: str, spawn: Callable[..., Process], capsys
) -> None:
    from websockets.sync.client import connect as dial

    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("left") as joined:
        joined.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
        port = str(free_port())
        process = spawn("-m", "factorbus.cli", "gateway", "--connect", endpoint, "--port", port)
        (address,) = process.ready()
        assert main(["gateway", "--connect", endpoint, "--port", port]) == USAGE
        assert "[port_taken]" in capsys.readouterr().err
        with dial(f"{address.replace('http', 'ws')}/api/maps/left/live") as socket:
            socket.recv(timeout=60)
            process.signal(signal.SIGTERM)
            assert process.wait() == OK
