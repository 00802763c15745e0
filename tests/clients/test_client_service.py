"""The client against the real service in a process of its own: sync, asyncio, the examples, a killed service."""

import asyncio
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from factorbus.client import Draft, Map, NoAnswerYet, Refused, Unavailable, aio, connect
from factorbus.proto.messages import Batch, Delta
from factorbus.proto.symbols import symbol

pytestmark = pytest.mark.timeout(300)  # the first service on a machine compiles its kernels

EXAMPLES = Path(__file__).parents[2] / "clients" / "examples"
SIGMAS = (0.1, 0.1, 0.02)


class Service:
    """A service process."""

    def __init__(self, endpoint: str) -> None:
        command = [sys.executable, "-m", "factorbus.service", "--listen", endpoint]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert self.process.stdout is not None
        said = self.process.stdout.readline().split()
        assert said[:1] == ["ready"]
        self.endpoint = said[1]

    def kill(self) -> None:
        self.process.kill()
        self._gone()

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self._gone()

    def _gone(self) -> int:
        status = self.process.wait(60)
        assert self.process.stdout is not None
        self.process.stdout.close()
        return status


@pytest.fixture(scope="module")
def service() -> Iterator[Service]:
    running = Service("tcp/127.0.0.1:0")
    yield running
    assert running.stop() == 0


def not_finite() -> Batch:
    """What a draft would refuse by itself."""
    (group,) = Draft().between_se2("x0", "x1", (1, 0, 0), sigmas=SIGMAS).batch().factors
    return Batch((), (group._replace(measured=np.full((1, 3), np.nan)),))


def start() -> Draft:
    return Draft().se2("x0", (0, 0, 0), fixed=True)


def step(i: int) -> Draft:
    return Draft().se2(f"x{i}").between_se2(f"x{i - 1}", f"x{i}", (1, 0, 0.1), sigmas=SIGMAS)


def assert_bitwise_like_the_service(joined: Map) -> None:
    asked = joined.ask_estimate()
    assert asked.revision == joined.estimate.revision
    told = {int(k): v.tobytes() for group in asked.variables for k, v in zip(group.keys, group.values, strict=True)}
    keys, values = joined.estimate.columns("se2")
    assert {int(k): v.tobytes() for k, v in zip(keys, values, strict=True)} == told


def test_a_loop_is_closed_over_the_bus(service: Service) -> None:
    with connect(service.endpoint, client="robot1", timeout_s=60) as bus, bus.map("loop") as loop:
        loop.insert(start())
        for i in range(1, 5):
            turn = (10, 0, np.radians(92))
            odometry = Draft().se2(f"x{i}").between_se2(f"x{i - 1}", f"x{i}", turn, sigmas=SIGMAS)
            accepted = loop.insert(odometry)
            assert accepted.first_factor == i - 1
        open_ended = loop.estimate["x4"]
        accepted = loop.insert(Draft().between_se2("x0", "x4", (0, 0, 0), sigmas=SIGMAS))
        assert np.hypot(*loop.estimate["x4"][:2]) < 0.1 * np.hypot(*open_ended[:2])
        settled = loop.settle()
        assert settled.report["converged"]
        chi2 = loop.chi2(batch=True)
        assert chi2.batch == pytest.approx(chi2.chi2, rel=1e-9)
        assert settled.report["chi2"] == pytest.approx(chi2.chi2)
        assert_bitwise_like_the_service(loop)
        assert loop.ask_estimate(["x4"]).variables[0].values.tobytes() == loop.estimate["x4"].tobytes()
        graph = loop.graph()
        assert (graph.batch.variable_count, graph.batch.factor_count) == (5, 5)
        assert loop.stats()["revision"] == settled.revision
        assert loop.export("g2o").count("EDGE_SE2") == 5
        assert len(loop.export("tum").splitlines()) == 5
        assert loop.export("pyfg").count("EDGE_SE2 ") == 5
        assert loop.export("jrl").count("BetweenFactorPose2") == 5
        assert [row.variables for row in bus.maps() if row.name == "loop"] == [5]
        bus.drop("loop")
        assert not [row for row in bus.maps() if row.name == "loop"]


REFUSED = {
    "duplicate_variable": start(),
    "unknown_variable": Draft().between_se2("x0", "x9", (1, 0, 0), sigmas=SIGMAS),
    "self_loop": Draft().between_se2("x0", "x0", (1, 0, 0), sigmas=SIGMAS),
    "kind_mismatch": Draft().landmark_se2("x0", "x1", (1, 0), sigmas=(1, 1)),
    "not_finite": not_finite(),
    "not_positive_definite": Draft().between_se2("x0", "x1", (1, 0, 0), information=np.diag([1, -1, 1])),
    "bad_range": Draft().point2("l1").bearing_range_se2("x1", "l1", (0, -1), sigmas=(1, 1)),
    "bad_quaternion": Draft().se3("y1", (0, 0, 0, 1, 1, 1, 1)),
    "uninitialized": Draft().se2("x7"),
    "underconstrained": Draft().se2("x8", (0, 0, 0)),
}


def test_what_is_refused_leaves_the_map_as_it_was(service: Service) -> None:
    with connect(service.endpoint, timeout_s=60) as bus, bus.map("strict") as strict:
        strict.insert(start())
        strict.insert(step(1))
        before = strict.ask_estimate()
        for code, draft in REFUSED.items():
            with pytest.raises(Refused) as caught:
                strict.insert(draft)
            assert (code, caught.value.code) == (code, code)
        after = strict.ask_estimate()
        assert after.revision == before.revision
        assert repr(after) == repr(before)
        assert strict.insert(step(2)).revision == before.revision + 1


@pytest.mark.parametrize("closing", ["map", "bus", "with"])
def test_leaving_says_what_was_refused_and_nobody_has_looked_at(service: Service, closing: str) -> None:
    """Also where the answer has not come yet: then that there is none."""
    bus = connect(service.endpoint, client="leaver", timeout_s=60)
    left = bus.map(f"left-{closing}")
    left.insert(start())
    seen, unseen = left.send(step(3)), left.send(step(5))
    with pytest.raises(Refused):
        seen.result()
    unseen.request.future.exception(60)  # until it is answered; nobody looks at what it says
    leave = {"map": left.close, "bus": bus.close, "with": lambda: bus.__exit__(None, None, None)}[closing]
    with pytest.raises(Refused) as caught:
        leave()
    assert caught.value.code == "unknown_variable"
    assert left.closed
    left.close()
    bus.close()


def test_a_bus_that_is_closed_says_what_all_of_its_maps_refused(service: Service) -> None:
    bus = connect(service.endpoint, client="of-several", timeout_s=60)
    for number in range(3):
        joined = bus.map(f"several-{number}")
        joined.insert(start())
        joined.send(step(3 + number)).request.future.exception(60)
    with pytest.raises(Refused, match="x2") as caught:
        bus.close()
    assert [str(other).count(f"x{2 + k}") > 0 for k, other in enumerate(caught.value.others, 1)] == [True, True]
    bus.close()


def test_leaving_after_an_error_raises_that_error(service: Service) -> None:
    def fail() -> None:
        with connect(service.endpoint, client="failing", timeout_s=60) as bus:
            joined = bus.map("failing")
            joined.insert(start())
            joined.send(step(7)).request.future.exception()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()


def test_a_stream_through_the_window_and_a_viewer_that_comes_late(service: Service) -> None:
    with connect(service.endpoint, timeout_s=60) as bus, bus.map("stream", window=16) as stream:
        stream.send(start())
        pending_inserts = [stream.send(step(i)) for i in range(1, 200)]
        stream.flush()
        assert [pending_insert.result().sequence for pending_insert in pending_inserts] == list(range(2, 201))
        with connect(service.endpoint) as other, other.map("stream", create=False) as viewer:
            last = stream.insert(Draft().between_se2("x0", "x199", (0, 5, 0.1), sigmas=SIGMAS)).revision
            viewer.estimate.wait_for(last)
            seen, ours = viewer.estimate.snapshot(), stream.estimate.snapshot()
            assert (seen.epoch, seen.revision) == (ours.epoch, ours.revision)
            for column, own in zip(seen.columns["se2"], ours.columns["se2"], strict=True):
                assert column.tobytes() == own.tobytes()
        assert_bitwise_like_the_service(stream)


def test_the_same_under_asyncio(service: Service) -> None:
    async def drive() -> list[Delta]:
        heard: list[Delta] = []

        async def listen(joined: aio.Map) -> None:
            async for delta in joined.deltas():
                heard.append(delta)
                if "x50" in joined.estimate:
                    return

        async with aio.connect(service.endpoint, timeout_s=60) as bus, bus.map("async", window=8) as joined:
            listener = asyncio.create_task(listen(joined))
            await asyncio.sleep(0)  # it has subscribed
            assert (await joined.insert(start())).revision == 1
            pending_inserts = [await joined.send(step(i)) for i in range(1, 51)]
            assert (await joined.result(pending_inserts[0])).sequence == 2
            await joined.flush()
            await listener
            with pytest.raises(Refused, match="x0"):
                await joined.insert(start())
            accepted = await joined.settle()
            await joined.wait_for(accepted.revision)
            assert (await joined.chi2()).chi2 == pytest.approx(0, abs=1e-12)
            assert (await joined.graph()).batch.factor_count == 50
            assert (await joined.stats())["revision"] == accepted.revision
            assert (await joined.export()).count("EDGE_SE2") == 50
            asked = await joined.ask_estimate(["x1"])
            assert asked.variables[0].keys.tolist() == [symbol("x", 1)]
            assert [row.name for row in await bus.maps() if row.name == "async"] == ["async"]
            await bus.drop("async")
        return heard

    heard = asyncio.run(drive())
    assert all(second.previous in (0, first.revision) for first, second in pairwise(heard))


def test_asyncio_waits_no_longer_than_it_is_told() -> None:
    async def drive() -> None:
        async with aio.connect("tcp/127.0.0.1:1", timeout_s=0.1):
            pass

    with pytest.raises(Unavailable, match="factorbus serve"):
        asyncio.run(drive())


def test_a_killed_service_comes_back_empty_and_the_client_says_so(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/bus.sock"
    service = Service(endpoint)
    with connect(endpoint, timeout_s=60) as bus, bus.map("kitchen") as kitchen:
        kitchen.insert(start())
        first = kitchen.epoch
        service.kill()
        pending_insert = kitchen.send(step(1))
        with pytest.raises(NoAnswerYet):
            pending_insert.result(0.3)
        assert kitchen.estimate.stale
        assert kitchen.estimate["x0"].tolist() == [0, 0, 0]
        service = Service(endpoint)
        with pytest.raises(Refused) as caught:
            pending_insert.result()
        assert caught.value.code in ("unknown_map", "wrong_epoch")
        with connect(endpoint, timeout_s=60) as other, other.map("kitchen") as anew:
            anew.insert(start())
            with suppress(Refused):
                kitchen.insert(step(1))
            kitchen.estimate.wait_for(1)
            assert kitchen.estimate.epoch == anew.epoch != first
            with pytest.raises(Refused) as caught:
                kitchen.insert(step(1))
            assert caught.value.code == "wrong_epoch"
            assert kitchen.rejoin() == anew.epoch
            kitchen.insert(step(1))
            assert_bitwise_like_the_service(kitchen)
    assert service.stop() == 0


def test_the_examples_run(service: Service) -> None:
    viewer = [sys.executable, EXAMPLES / "viewer.py", service.endpoint, "example", "6"]
    with subprocess.Popen(viewer, stdout=subprocess.PIPE, text=True) as watching:
        assert watching.stdout is not None
        assert watching.stdout.readline() == "map example at revision 0: 0 variables\n"
        square = run_example("square.py", service.endpoint, "example")
        seen, _ = watching.communicate(timeout=60)
    assert watching.returncode == 0
    assert "by odometry the robot is at [ 0.721 -0.649  0.14 ]" in square
    assert "after the loop closure" in square
    assert "revision 6 (since 5)" in seen
    assert "last pose [19.  0.  0.]" in run_example("async_robot.py", service.endpoint, "corridor")


def run_example(name: str, *arguments: str) -> str:
    command = [sys.executable, EXAMPLES / name, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout


# What an import of the client brings from outside the standard library, and why.
BROUGHT = {
    "numpy": "values and information matrices are its arrays",
    "zenoh": "the bus",
    "msgpack": "messages are its bytes",
    "factorbus": "client and protocol",
}
OURS = {"factorbus.client", "factorbus.proto", "factorbus.wording"}
TYPES = {"numpy.typing", "numpy._typing._add_docstring"}  # annotations; 0.6 ms
# Of the standard library: large, and what some other part of the package may want, not this one.
NOT_WANTED = {
    "asyncio", "email", "http", "importlib.metadata", "multiprocessing", "sqlite3", "ssl", "subprocess", "tempfile",
    "unittest", "xml",
}  # fmt: skip


def imported_by(statement: str) -> set[str]:
    """The modules that are there after `statement` in a fresh interpreter."""
    names = "(name for name, module in sys.modules.items() if getattr(module, '__spec__', None))"
    code = f"import sys; {statement}; print(*{names})"
    ran = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, timeout=60, check=True)
    return set(ran.stdout.split())


def test_the_client_is_light() -> None:
    """What an import costs is what it brings: measured, two thirds of 0.16 s are NumPy's."""
    bare, numpy, client = map(imported_by, ("pass", "import numpy", "import factorbus.client"))
    brought = {name.partition(".")[0] for name in client - bare} - sys.stdlib_module_names
    assert brought == set(BROUGHT)
    packages = {".".join(name.split(".")[:2]) for name in client if name.startswith("factorbus.")}
    assert packages == OURS
    assert {name for name in client if name.startswith("numpy.")} <= numpy | TYPES, "of NumPy, what it brings itself"
    assert not NOT_WANTED & (client - numpy)
    beside = imported_by("import factorbus.client.aio") - client - imported_by("import asyncio")
    assert {name.rpartition(".")[0] for name in beside} == {"factorbus.client"}
