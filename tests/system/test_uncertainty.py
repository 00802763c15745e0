"""Questions about uncertainty over the bus: a service process, the client library, asyncio and the command line."""

import asyncio
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from naive.solver_parts import graph_in
from processes import Process

from factorbus.client import Draft, Map, Refused, aio, connect
from factorbus.proto.messages import Batch
from factorbus.proto.problems import BadOption
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.candidates import evaluate_candidates

pytestmark = pytest.mark.timeout(400)  # the first service on a machine compiles its kernels
SIGMAS = (0.1, 0.1, 0.02)


def drive() -> Iterator[Batch]:
    """Round a square, two landmarks seen from several places."""
    yield Draft().se2("x0", (0, 0, 0), fixed=True).batch()
    for i in range(1, 9):
        step = Draft().se2(f"x{i}").between_se2(f"x{i - 1}", f"x{i}", (1, 0.02, 0.78), sigmas=SIGMAS)
        if i in (1, 3):
            step.point2(f"l{i}")
        if i in (1, 2, 5):
            step.landmark_se2(f"x{i}", "l1", (1.0 + 0.01 * i, 1.0), sigmas=(0.2, 0.2))
        if i in (3, 4):
            step.landmark_se2(f"x{i}", "l3", (2.0, -1.0 + 0.02 * i), sigmas=(0.2, 0.2))
        yield step.batch()
    yield Draft().between_se2("x8", "x0", (0.1, 0, 0), sigmas=SIGMAS).batch()


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    process = Process(
        tmp_path_factory.mktemp("service") / "log", "-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0"
    )
    try:
        yield process.ready()[0]
    finally:
        process.end()


@pytest.fixture(params=["bayes-tree", "inc-l"])
def square(endpoint: str, request: pytest.FixtureRequest) -> Iterator[tuple[Map, Solver]]:
    """A map on the bus, and a solver in the same mode with the same inserts."""
    twin = Solver(Options(mode=request.param))
    with (
        connect(endpoint, client="asker", timeout_s=60) as bus,
        bus.map(f"square-{request.param}", request.param) as joined,
    ):
        for batch in drive():
            if joined.stats()["revision"] < 10:
                joined.insert(batch)
            twin.stage(batch)
            twin.step()
        yield joined, twin


def index(twin: Solver, *names: str) -> np.ndarray:
    return np.array([graph_in(twin).find(symbol(name[0], int(name[1:]))) for name in names])


def test_covariances_are_those_of_the_solver(square: tuple[Map, Solver]) -> None:
    joined, twin = square
    blocks, revision = CovarianceBlocks(twin.covariances.factored()), joined.stats()["revision"]
    every = joined.uncertainty.covariance()
    assert every.revision == revision
    assert sum(len(group.keys) for group in every.groups) == twin.variable_count
    for name in ("x4", "x8", "l1"):
        (v,) = index(twin, name)
        d = 2 if name[0] == "l" else 3
        np.testing.assert_allclose(every[name], blocks.diagonal()[v, :d, :d], rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(joined.uncertainty.covariance([name])[name], every[name], rtol=1e-6, atol=1e-12)
    assert not every["x0"].any()
    assert joined.uncertainty.last().groups[0].keys.tolist() == [symbol("x", 8)]
    names = ["l3", "x2", "x0", "x7"]
    joint = blocks.joint(index(twin, *names))
    np.testing.assert_allclose(joined.uncertainty.joint(names), joint, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(joined.uncertainty.cross(names[:2], names[2:]), joint[:5, 5:], rtol=1e-6, atol=1e-10)
    pair = joined.uncertainty.relative([("x2", "x7"), ("x7", "l3")])
    assert {group.kind for group in pair.groups} == {"se2", "point2"}
    assert all(group.values is not None and len(group.values) == 1 for group in pair.groups)


def test_candidates_are_gated_and_weighed(square: tuple[Map, Solver]) -> None:
    joined, twin = square
    right = joined.uncertainty.relative([("x2", "x6")]).groups[0].values
    assert right is not None
    draft = Draft().between_se2("x2", "x6", tuple(right[0]), sigmas=SIGMAS)
    draft.between_se2("x2", "x6", (right[0][0] + 3.0, *right[0][1:]), sigmas=SIGMAS)
    found, gain = joined.uncertainty.gate(draft), joined.uncertainty.gain(draft)
    assert found.plausible.tolist() == [True, False]
    assert found.dims.tolist() == [3, 3]
    wanted = evaluate_candidates(CovarianceBlocks(twin.covariances.factored()), draft.batch().factors)
    np.testing.assert_allclose(found.distance, wanted.distance, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(gain.gain, wanted.gain, rtol=1e-6)
    many = Batch(factors=tuple(draft.batch().factors) * 40)  # no longer between two steps
    np.testing.assert_allclose(joined.uncertainty.gate(many).distance[:2], found.distance, rtol=1e-6, atol=1e-9)


def test_observations_are_associated(square: tuple[Map, Solver]) -> None:
    joined, _ = square
    seen = [joined.uncertainty.relative([("x8", name)]).groups[0].values[0] for name in ("l3", "l1")]
    found = joined.uncertainty.associate("x8", "landmark_se2", [*seen, [50.0, 50.0]], information=np.diag([25.0, 25.0]))
    assert found.matched.tolist() == [True, True, False]
    assert found.landmarks[:2].tolist() == [symbol("l", 3), symbol("l", 1)]
    assert found.complete
    assert found.distance < 1e-6 < found.threshold


def test_why(square: tuple[Map, Solver]) -> None:
    joined, _ = square
    explained = joined.uncertainty.why("l1")
    assert explained.variable["kind"] == "point2"
    assert {factor["kind"] for factor in explained.variable["factors"]} == {"landmark_se2"}
    assert explained.step["because"]
    factor = joined.uncertainty.why(factor=explained.variable["factors"][0]["factor"]).factor
    first = explained.variable["factors"][0]
    assert factor.keys() == first.keys()
    assert (factor["kind"], factor["keys"], factor["chi2"]) == (first["kind"], first["keys"], first["chi2"])
    assert factor["leverage"] == pytest.approx(first["leverage"], rel=1e-9)


@pytest.mark.parametrize("named", [["x77"], ["x1", "x2", "x3", "x4", "x5", "x6", "x7", "x8", "x77"]])
def test_refusals_carry_their_codes(square: tuple[Map, Solver], named: list[str]) -> None:
    joined, _ = square
    with pytest.raises(Refused, match="x77") as refused:
        joined.uncertainty.covariance(named)
    assert refused.value.code == "unknown_variable"
    with pytest.raises(Refused) as refused:
        joined.uncertainty.relative([("l1", "x1")])
    assert refused.value.code == "kind_mismatch"
    with pytest.raises(Refused) as refused:
        joined.uncertainty.why(factor=999)
    assert refused.value.code == "unknown_factor"
    with pytest.raises(Refused) as refused:
        joined.uncertainty.gate(Draft().between_se2("x1", "x99", (1, 0, 0), sigmas=SIGMAS))
    assert refused.value.code == "unknown_variable"
    with pytest.raises(BadOption, match=r"probability: 1\.5"):  # before it is sent
        joined.uncertainty.gate(Draft().between_se2("x1", "x2", (1, 0, 0), sigmas=SIGMAS), probability=1.5)


def test_an_empty_map_has_no_last_pose(endpoint: str) -> None:
    with connect(endpoint, client="asker", timeout_s=60) as bus, bus.map("empty", "bayes-tree") as empty:
        with pytest.raises(Refused) as refused:
            empty.uncertainty.last()
        assert refused.value.code == "unknown_variable"
        assert empty.uncertainty.covariance().groups == ()


def test_asyncio_asks_the_same(endpoint: str, square: tuple[Map, Solver]) -> None:
    joined, _ = square

    async def asked() -> None:
        async with (
            aio.connect(endpoint, client="asker") as bus,
            bus.map(joined.name, joined.mode, mirror=False) as same,
        ):
            every, joint, cross, pair, why = await asyncio.gather(
                same.uncertainty.covariance(["x3"]),
                same.uncertainty.joint(["x3", "l1"]),
                same.uncertainty.cross(["x3"], ["l1"]),
                same.uncertainty.relative([("x3", "l1")]),
                same.uncertainty.why("x3"),
            )
            np.testing.assert_allclose(joint[:3, :3], every["x3"], rtol=1e-6, atol=1e-12)
            np.testing.assert_allclose(cross, joint[:3, 3:], rtol=1e-6, atol=1e-12)
            assert pair.groups[0].covariance.shape == (1, 2, 2)
            assert why.variable["kind"] == "se2"
            assert (await same.uncertainty.last()).groups[0].kind == "se2"
            draft = Draft().between_se2("x3", "x5", (1, 0, 0), sigmas=SIGMAS)
            gate, gain = await asyncio.gather(same.uncertainty.gate(draft), same.uncertainty.gain(draft))
            assert gate.distance.size == gain.gain.size == 1
            found = await same.uncertainty.associate("x3", "landmark_se2", [[1.0, 1.0]], information=np.eye(2))
            assert found.matched.size == 1

    asyncio.run(asked())


def ask(*arguments: str) -> "subprocess.CompletedProcess[str]":
    program = str(Path(sys.executable).with_name("factorbus"))
    return subprocess.run([program, "ask", *arguments], capture_output=True, text=True, timeout=100, check=False)


def test_the_command_line_asks(endpoint: str, square: tuple[Map, Solver], tmp_path: Path) -> None:
    name, at = square[0].name, ["--connect", endpoint]
    ran = ask("covariance", name, "x4", "l1", *at, "--json")
    assert ran.returncode == 0, ran.stderr
    said = json.loads(ran.stdout)
    assert {tuple(row["keys"]) for row in said["blocks"]} == {("x4",), ("l1",)}
    for form in (["x4", "x5", "--relative"], ["x4", "l1", "--joint"], ["--last"], []):
        ran = ask("covariance", name, *form, *at)
        assert ran.returncode == 0, ran.stderr
        assert ran.stdout.strip()
    file = tmp_path / "candidates.g2o"
    file.write_text("EDGE_SE2 2 6 30 0 0 100 0 0 100 0 2500\n")
    ran = ask("gate", name, str(file), *at, "--json")
    assert ran.returncode == 1, ran.stderr
    assert json.loads(ran.stdout)["candidates"][0]["plausible"] is False
    for content in ("VERTEX_SE2 2 0 0 0\n", "EDGE_NOTHING 2 6 1\n", ""):
        nothing = tmp_path / "nothing.g2o"
        nothing.write_text(content)
        for question in ("gate", "gain"):
            ran = ask(question, name, str(nothing), *at)
            assert (ran.returncode, ran.stdout, "[bad_file]" in ran.stderr) == (3, "", True)
    mixed = tmp_path / "mixed.g2o"
    mixed.write_text("EDGE_SE2 4 5 0 0 0 1 0 0 1 0 1\nEDGE_NOTHING 2 6 1\n")
    assert ask("gate", name, str(mixed), *at, "--probability", "0.999999").returncode in (0, 1)
    assert ask("gate", name, str(mixed), *at, "--strict").returncode == 3
    ran = ask("gain", name, str(file), *at)
    assert ran.returncode == 0, ran.stderr
    assert "between_se2 (x2, x6)" in ran.stdout
    ran = ask("why", name, "x4", *at)
    for term in ("smallest pivot of R", "smallest R²ᵢᵢ/Λᵢᵢ", "leverage ", "Its factors, by id"):
        assert term in ran.stdout
    assert " step " not in ran.stdout.replace("the last step", ""), "a step has another number than the revision"
    assert ran.returncode == 0, ran.stderr
    assert "because" in ran.stdout
    ran = ask("why", name, "3", *at, "--json")
    assert json.loads(ran.stdout)["factor"]["factor"] == 3
    assert ask("why", "nowhere", "x4", *at).returncode in (4, 5)
    assert ask("why", name, "x99", *at).returncode == 5
