"""`factorbus replay`: the same file in this process and over the bus, and what is said and written about it."""

import json
import math
import os
import re
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import pytest
from few_tries import give_up_after

from factorbus.cli.driving.columns import merged
from factorbus.cli.driving.drive import Compared
from factorbus.cli.driving.local import LocalMap
from factorbus.cli.main import main
from factorbus.cli.output.exits import FAILED, INTERRUPTED, OK, REFUSED
from factorbus.cli.process.children import service
from factorbus.client import connect
from factorbus.datasets import CATALOGUE, dataset_named
from factorbus.formats import read
from factorbus.simulate import Spiral, sphere
from factorbus.solver import solve_batch

FACTORBUS = str(Path(sys.executable).with_name("factorbus"))
POSES = 250


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("worlds") / "town.g2o"
    assert main(["simulate", "manhattan", "--poses", str(POSES), "--seed", "3", "--out", str(path)]) == OK
    return path


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with service() as (_, endpoint):
        yield endpoint


@pytest.fixture(scope="module")
def local(town: Path) -> dict[str, Any]:
    return replayed(town, "--in-process", "--every", "100")


def replayed(*arguments: "str | Path", timeout_s: float = 100) -> dict[str, Any]:
    """The document, which must be all there is on standard output."""
    command = [FACTORBUS, "replay", *map(str, arguments), "--json"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    assert ran.returncode == OK, ran.stderr
    return json.loads(ran.stdout, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def test_in_process(local: dict[str, Any], town: Path) -> None:
    graph = read(town)
    assert (local["poses"], local["landmarks"], local["factors"]) == (POSES, 0, graph.batch.factor_count)
    assert local["steps"] == local["inserts"] == POSES
    assert local["revision"] == POSES + 1
    assert local["settled"]
    assert local["mode"] == "bayes-tree"
    assert sum(local["strategies"].values()) == POSES
    assert local["strategies"]["tree"] > 10
    for name in ("p50", "p95", "p99", "max"):
        assert local["step_ms"][name] > 0
    assert local["step_ms"]["p50"] <= local["step_ms"]["p95"] <= local["step_ms"]["p99"] <= local["step_ms"]["max"]
    assert local["bus_ms"] is None
    assert local["seconds"] > local["solver_cpu_s"] * 0.5 > 0
    assert local["kernels_compiled_s"] >= 0
    assert local["chi2"] <= local["chi2_unsettled"] < local["chi2_initial"]


def test_chi2_along_the_drive_is_the_batch_optimum(local: dict[str, Any]) -> None:
    assert [each["revision"] for each in local["against_batch"]] == [100, 200]
    for each in local["against_batch"]:
        assert 1 - 1e-6 < each["ratio"] < 1.01
        assert each["ratio"] == each["chi2"] / each["batch"]


def test_over_the_bus_it_ends_at_the_same_optimum(local: dict[str, Any], town: Path, tmp_path: Path) -> None:
    out, tum, plot = tmp_path / "out.g2o", tmp_path / "out.tum", tmp_path / "out.png"
    bus = replayed(town, "--every", "100", "--out", out, "--tum", tum, "--plot", plot)
    assert bus["chi2"] == pytest.approx(local["chi2"], rel=1e-12)
    assert bus["chi2_initial"] == local["chi2_initial"]
    for name in ("poses", "landmarks", "factors", "steps", "inserts", "revision", "mode", "strategies", "settled"):
        assert bus[name] == local[name], name
    assert bus["deltas"] == bus["revision"]
    assert set(bus["bus_ms"]) == {"p50", "p95", "p99", "max"}
    assert bus["bus_ms"]["p50"] > 0
    assert bus["solver_cpu_s"] > 0
    assert [each["revision"] for each in bus["against_batch"]] == [100, 200]
    assert {each["worker"] for each in bus["against_batch"]} == {"worker1"}
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert len(tum.read_text().splitlines()) == POSES
    again = replayed(out, "--in-process", "--use-values")
    assert again["chi2_initial"] == pytest.approx(bus["chi2"], rel=1e-9)


def test_into_a_running_service_with_inserts_in_flight(endpoint: str, local: dict[str, Any], town: Path) -> None:
    windowed = replayed(town, "--connect", endpoint, "--map", "windowed", "--window", "16")
    assert windowed["inserts"] == POSES
    assert windowed["steps"] <= POSES
    assert windowed["revision"] == windowed["steps"] + 1 == windowed["deltas"]
    assert windowed["chi2"] == pytest.approx(local["chi2"], rel=1e-6)
    assert windowed["closure_states"] is local["closure_states"] is None


def test_closures_that_are_tested_are_counted_at_the_end(
    endpoint: str, town: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = ("--connect", endpoint, "--map", "tested", "--closures", "test")
    assert main(["replay", str(town), *arguments]) == OK
    with connect(endpoint, client="looks") as bus, bus.map("tested", create=False) as tested:
        counts = tested.suspects().counts
    assert sum(counts.values()) > 0
    shown = re.search(r"closures +(\d+ accepted, .*)", capfd.readouterr().out)
    assert shown is not None
    assert shown[1].rstrip().split(", ") == [f"{count} {state}" for state, count in counts.items()]


def test_a_map_that_is_not_empty_is_refused(endpoint: str, town: Path) -> None:
    first = replayed(town, "--connect", endpoint, "--map", "once", "--no-settle")
    assert first["revision"] == POSES
    assert first["chi2"] == first["chi2_unsettled"]
    ran = subprocess.run(
        [FACTORBUS, "replay", str(town), "--connect", endpoint, "--map", "once", "--json"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ran.returncode == REFUSED
    assert json.loads(ran.stdout)["problem"]["code"] == "map_not_empty"
    assert re.search(r"is at revision \d+ already", ran.stderr)  # further steps count too


def test_what_was_written_where_is_said(town: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    files = {name: tmp_path / f"town.{name}" for name in ("pyfg", "tum", "kitti", "png")}
    options = {"--out": "pyfg", "--tum": "tum", "--kitti": "kitti", "--plot": "png"}
    asked = [word for option, name in options.items() for word in (option, str(files[name]))]
    assert main(["replay", str(town), "--in-process", *asked, "--json"]) == OK
    said = capfd.readouterr()
    told = json.loads(said.out)
    assert told["written"] == [str(path) for path in files.values()]
    assert told["left_out"] == {"fixed variables": 1}
    assert told["notes"] == [
        "1 fixed variable written as free: PyFactorGraph (.pyfg) does not say which variables are fixed"
    ]
    for name, what in (
        ("pyfg", "the map"),
        ("tum", "the trajectory"),
        ("kitti", "the trajectory"),
        ("png", "the picture"),
    ):
        assert f"{files[name]}: {what} written" in said.err
        assert files[name].stat().st_size > 0


def test_what_a_person_sees(town: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(town), "--in-process"]) == OK
    shown = capfd.readouterr()
    assert f"{POSES} poses, 0 landmarks" in shown.out
    assert "p99" in shown.out
    assert f"{POSES}/{POSES}" in shown.err


def test_intel_ends_at_the_reference_optimum(datasets: Path) -> None:
    found = replayed(datasets / "intel.g2o")
    assert found["chi2"] == pytest.approx(546.46111, rel=1e-6)
    assert found["chi2_initial"] == pytest.approx(205887.287, rel=1e-6)
    assert (found["poses"], found["factors"]) == (943, 1837)


@pytest.mark.data
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    "name",
    [
        "killian",
        "killian_freiburg",
        "manhattan3500",
        "sphere2500",
        "citytrees10000",
        "victoria_park",
        "city10000",
        "w10000",
    ],
)
def test_a_data_set_over_the_bus_ends_at_the_reference_optimum(datasets: Path, name: str) -> None:
    known = dataset_named(name, CATALOGUE)
    found = replayed(datasets / known.file, timeout_s=1800)
    print(
        f"{name}: {found['seconds']:.0f} s, solver {found['solver_cpu_s']:.1f} s CPU, step p99 "
        f"{found['step_ms']['p99']:.1f} ms, χ² {found['chi2']:.12g} ({found['chi2'] / known.optimum - 1:+.1e})"
    )
    assert (found["poses"], found["landmarks"]) == (known.poses, known.landmarks)
    assert found["steps"] == known.poses
    assert found["settled"]
    assert found["chi2"] == pytest.approx(known.optimum, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    ("number", "whom", "code", "said"),
    [
        (signal.SIGINT, "parent", INTERRUPTED, "interrupted"),
        (signal.SIGTERM, "parent", INTERRUPTED, "interrupted"),
        (signal.SIGKILL, "parent", -signal.SIGKILL, ""),
        (signal.SIGKILL, "solver", FAILED, "the solver process ended with exit code -9"),
    ],
)
def test_no_process_is_left_whichever_is_killed(number: int, whom: str, code: int, said: str, long_drive: Path) -> None:
    with subprocess.Popen(
        [FACTORBUS, "replay", str(long_drive)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stderr is not None
            pid, endpoint = announced(process.stderr)
            solver = os.pidfd_open(pid)
            with connect(endpoint, client="watcher", timeout_s=60) as bus, bus.map("replay") as watched:
                watched.estimate.wait_for(100, timeout_s=60)
                os.kill(process.pid if whom == "parent" else pid, number)
            _, error = process.communicate(timeout=60)
            assert select.select([solver], [], [], 60)[0], "the solver process is still there"
            os.close(solver)
        finally:
            process.kill()  # one that goes on driving would be waited for
    assert process.returncode == code, error
    assert said in error
    assert "Traceback" not in error


@pytest.fixture(scope="module")
def long_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("worlds") / "long.g2o"
    assert main(["simulate", "manhattan", "--poses", "20000", "--out", str(path)]) == OK
    return path


def announced(lines: IO[str]) -> tuple[int, str]:
    """(pid, endpoint) from the line that says so."""
    for line in lines:
        if found := re.search(r"solver process (\d+) on (\S+)", line):
            return int(found[1]), found[2]
    pytest.fail("the replay did not say where its solver process is")


@pytest.fixture(scope="module")
def wound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ring of 16 exact relative poses, its values wound once too often: a minimum of its own."""
    turn, lines = 2 * math.pi / 16, []
    for i in range(16):
        angle = math.remainder(2 * turn * i, 2 * math.pi)
        lines.append(f"VERTEX_SE2 {i} 0 0 {angle:.17g}")
    step = (math.cos(turn / 2) * 2 * math.sin(turn / 2), 2 * math.sin(turn / 2) ** 2, turn)
    for i in range(16):
        z = " ".join(f"{number:.17g}" for number in step)
        lines.append(f"EDGE_SE2 {i} {(i + 1) % 16} {z} 100 0 0 100 0 2500")
    path = tmp_path_factory.mktemp("worlds") / "wound.g2o"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_map_in_a_worse_minimum_adopts_the_better_one(wound: Path) -> None:
    """All at once, so that it stays wound; driven pose by pose it does not."""
    target = LocalMap("auto")
    (step,) = target.send(read(wound).whole())
    settled = target.settle()
    assert settled.report["chi2"] > 1.0
    found = target.optimum()
    assert found.notice is not None
    assert found.as_dict()["better_optimum"]
    assert found.start in ("odometry", "rotations")
    adopted = target.adopt(found)
    assert adopted.revision == step.revision + 2
    assert adopted.report["chi2"] < 1e-9
    assert target.optimum().notice is None


def test_what_the_batch_optimum_was_found_from_is_said(wound: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(wound), "--in-process", "--every", "16", "--use-values"]) == OK
    assert "from the file's values" in " ".join(capsys.readouterr().out.split())
    assert main(["replay", str(wound), "--in-process", "--every", "16"]) == OK
    assert "from the map's own values" in " ".join(capsys.readouterr().out.split())


def test_a_search_that_ended_before_it_had_converged_is_told(
    town: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["replay", str(town), "--in-process", "--every", "100"]
    assert main(command) == OK
    assert "not converged" not in capsys.readouterr().out
    give_up_after(1, monkeypatch.setattr)
    assert main([*command, "--json"]) == OK
    told = [each["batch_converged"] for each in json.loads(capsys.readouterr().out)["against_batch"]]
    assert False in told
    assert main(command) == OK
    shown = " ".join(capsys.readouterr().out.split())
    assert shown.count("not converged, the true optimum may be lower") == told.count(False)


def test_an_adopted_optimum_that_had_not_converged_is_called_so(
    wound: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = Compared(1, 2.0, 1.0, "w1", 0.5, "rotations", batch_converged=False)
    monkeypatch.setattr(LocalMap, "optimum", lambda _: found)
    monkeypatch.setattr(LocalMap, "adopt", lambda target, _: target.settle())
    assert main(["replay", str(wound), "--in-process"]) == OK
    shown = capsys.readouterr()
    for told in (shown.out, shown.err):
        assert "averaged rotations, not converged, the true optimum may be lower" in " ".join(told.split())


@pytest.mark.parametrize("seed", [1, 3])
def test_a_drive_over_a_sphere_of_much_noise_ends_at_the_best_of_the_starts(seed: int) -> None:
    world = sphere(300, seed, spiral=Spiral(25, 12), sigma_rotation_rad=0.25)
    target, batches = LocalMap("auto"), [step.batch for step in world]
    for batch in batches:
        target.send(batch)
    settled, found, graph = target.settle(), target.optimum(), merged(batches)
    assert settled.report["converged"]
    best = solve_batch(graph.variables, graph.factors)
    assert found.batch <= best.chi2 * (1 + 1e-6), "the map's own values are one start more"
    assert (found.notice is None) == (settled.report["chi2"] <= 1.01 * found.batch)
    assert target.adopt(found).report["chi2"] == pytest.approx(found.batch, rel=1e-6)
