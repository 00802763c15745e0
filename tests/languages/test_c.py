"""The C example, with every warning an error and under sanitizers: golden messages, and a robot on a real service."""

import json
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import free_port
from faulty.other_version import someone_of
from faulty.service import MAP, Service
from processes import Process, processes

from factorbus.client import Draft, connect
from factorbus.proto.problems import UnknownMap

ROOT = Path(__file__).parents[2]
EXAMPLE, VECTORS = ROOT / "clients" / "examples" / "c", ROOT / "proto" / "vectors"
FLAGS = "-std=c11 -g -O1 -Wall -Wextra -Wpedantic -Werror -fsanitize=address,undefined -fno-sanitize-recover=all"


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the programs.  Skips where there is no compiler."""
    if shutil.which("cc") is None or shutil.which("make") is None:
        pytest.skip("no C compiler (cc) or no make: the C example cannot be built")
    out = tmp_path_factory.mktemp("built")
    command = ["make", f"OUT={out}", f"CFLAGS={FLAGS}"]
    ran = subprocess.run(command, cwd=EXAMPLE, capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 0, ran.stderr
    return out


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with processes(tmp_path_factory.mktemp("service")) as start:
        yield start("-m", "factorbus.cli", "serve", "--listen", "tcp/127.0.0.1:0").ready()[0]


@pytest.fixture
def spawn(tmp_path: Path) -> Iterator[Callable[..., Process]]:
    with processes(tmp_path) as start:
        yield start


def run(program: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [program, *arguments]
    return subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", timeout=120, check=False)


def robot(built: Path, endpoint: str, name: str) -> "subprocess.CompletedProcess[str]":
    host, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
    return run(built / "robot", host, port, name)


def stamps(text: str) -> dict[str, int]:
    """The time stamps of poses, by key, as they are shown last."""
    return {key: int(stamp) for key, stamp in re.findall(r"^(x\d+) .* at (-?\d+) ns$", text, re.M)}


def poses(text: str) -> list[tuple[int, dict[str, list[float]]]]:
    """(revision, values by key) of each time they are shown."""
    shown: list[tuple[int, dict[str, list[float]]]] = []
    for line in text.splitlines():
        if line.endswith(":"):
            shown.append((int(re.findall(r"revision (\d+)", line)[0]), {}))
        else:
            key, *numbers = line.partition(" at ")[0].split()
            shown[-1][1][key] = [float(number) for number in numbers]
    return shown


def known(said: Any, described: Any) -> Any:
    """What the program says; columns whose names came after it, which it takes for f64, as they are described."""
    if isinstance(said, list) and isinstance(described, list) and len(said) == len(described):
        return [known(*pair) for pair in zip(said, described, strict=True)]
    if not (isinstance(said, dict) and isinstance(described, dict)):
        return said
    for name, dtype in (("i64", np.int64), ("u8", np.uint8)):
        if set(said) == {"f64"} and set(described) == {name}:
            return {name: np.array(said["f64"]).view(dtype).tolist()}
    return {name: known(each, described.get(name)) for name, each in said.items()}


def test_every_golden_message_is_read_and_written(built: Path) -> None:
    files = sorted(VECTORS.rglob("*.msgpack"))
    ran = run(built / "vectors", *map(str, files))
    assert (ran.returncode, ran.stderr) == (0, "")
    for file, line in zip(files, ran.stdout.splitlines(), strict=True):
        described = file.with_suffix(".json").read_text()
        # As text of Python's, so that 1 and 1.0, and every bit of a float, are told apart.
        assert json.dumps(known(json.loads(line), json.loads(described))) == json.dumps(json.loads(described)), (
            file.name
        )


def test_what_is_broken_is_refused_without_harm(built: Path, tmp_path: Path) -> None:
    random, files = np.random.default_rng(5), []
    for golden in sorted(VECTORS.rglob("*.msgpack")):
        whole = golden.read_bytes()
        for cut in random.integers(0, len(whole), 3):
            files.append(tmp_path / f"{len(files)}.cut")
            files[-1].write_bytes(whole[:cut])
        for _ in range(10):
            changed = bytearray(whole)
            changed[random.integers(0, len(whole))] = random.integers(0, 256)
            files.append(tmp_path / f"{len(files)}.changed")
            files[-1].write_bytes(changed)
    ran = run(built / "vectors", *map(str, files))
    assert ran.returncode == 1
    refused = re.findall(r"(\S+): not read", ran.stderr)
    assert {str(file) for file in files if file.suffix == ".cut"} <= set(refused)
    assert "Sanitizer" not in ran.stderr


@pytest.mark.timeout(400)
def test_a_robot_in_c_drives(built: Path, endpoint: str) -> None:
    ran = robot(built, endpoint, "square")
    assert (ran.returncode, ran.stderr) == (0, "")
    (_, before), (revision, after) = poses(ran.stdout)
    with connect(endpoint, client="looker") as bus, bus.map("square", create=False) as looked:
        assert looked.estimate.revision == revision == 6
        for key, value in after.items():
            np.testing.assert_array_equal(looked.estimate[key], value)
        assert len(after) == len(looked.estimate) == 5
        seen = {key: looked.estimate.stamp(key) for key in after}
        assert stamps(ran.stdout) == seen
        assert sorted(seen.values()) == list(seen.values())
        assert abs(seen["x4"] - time.time_ns()) < 400e9
    assert np.hypot(*before["x4"][:2]) > 0.05
    assert np.hypot(*after["x4"][:2]) < np.hypot(*before["x4"][:2]) / 10


@pytest.mark.timeout(400)
def test_a_refusal_is_told_with_its_code(built: Path, endpoint: str) -> None:
    with connect(endpoint, client="first") as bus, bus.map("taken") as taken:
        taken.insert(Draft().se2("x0", (1, 2, 3), fixed=True))
        ran = robot(built, endpoint, "taken")
        assert (ran.returncode, ran.stdout) == (1, "")
        assert re.fullmatch(r"factorbus/v1/map/taken/in/c-[0-9a-f]{8}: .*x0.* \[duplicate_variable\]\n", ran.stderr)
        assert taken.estimate["x0"].tolist() == [1, 2, 3]


@pytest.mark.timeout(400)
def test_an_estimate_larger_than_a_batch_comes_in_parts(built: Path, endpoint: str) -> None:
    """10,000 poses of another robot: 320 kB, which Zenoh sends as fragments."""
    crowd = Draft().se2("y0", (0, 0, 0), fixed=True)
    for n in range(1, 10_000):
        crowd.se2(f"y{n}").between_se2(f"y{n - 1}", f"y{n}", (1, 0, 0), sigmas=(0.1, 0.1, 0.1))
    with connect(endpoint, client="crowd") as bus, bus.map("crowd") as joined:
        joined.insert(crowd, timeout_s=60)
        ran = robot(built, endpoint, "crowd")
        assert (ran.returncode, ran.stderr) == (0, "")
        revision, after = poses(ran.stdout)[-1]
        joined.estimate.wait_for(revision)
        assert revision == 7
        np.testing.assert_array_equal(joined.estimate["x4"], after["x4"])


@pytest.mark.timeout(400)
def test_nobody_there_is_said(built: Path) -> None:
    ran = robot(built, f"tcp/127.0.0.1:{free_port()}", "square")
    assert ran.returncode == 1
    assert "nobody speaks Zenoh at 127.0.0.1" in ran.stderr
    assert run(built / "robot").returncode == 2


@pytest.mark.parametrize("version", ["v2", "v0", "v1.1"])
def test_a_service_of_another_version_is_told_from_silence(built: Path, version: str) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with someone_of(version, endpoint):
        ran = robot(built, endpoint, "square")
    assert (ran.returncode, ran.stdout) == (1, "")
    assert f"speak version {version} of the protocol, this robot v1" in ran.stderr
    assert ran.stderr.endswith(" [other_protocol]\n")


class Quiet(Service):
    """Says nothing when it is first asked for the estimate, for longer than silence takes to be looked into.

    Beside it is one of another version.
    """

    def __init__(self, folder: Path, endpoint: str) -> None:
        super().__init__(folder, endpoint=endpoint)
        self._other = self._session.liveliness().declare_token("factorbus/v2/features/s/live")

    def answered(self, question: str, payload: bytes) -> bytes | None:
        self.asked.append(question)
        if len(self.asked) <= 5:
            return None
        raise UnknownMap(MAP)


def test_a_service_that_has_answered_is_waited_for(built: Path, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    service = Quiet(tmp_path, endpoint)
    try:
        ran = robot(built, endpoint, MAP)
        assert ran.returncode == 1
        assert ran.stderr.endswith(" [unknown_map]\n")
        assert service.asked == ["estimate"] * 6
    finally:
        service.close()


def test_its_readme_names_what_there_is() -> None:
    text = (EXAMPLE / "README.md").read_text()
    commands = re.findall(r"^```bash\n(.*?)^```$", text, re.M | re.S)
    assert commands == ["make\n./vectors ../../../proto/vectors/*.msgpack\n", "./robot 127.0.0.1 7447 square\n"]
    assert set(re.findall(r"`(\w+\.[ch])`", text)) <= {path.name for path in EXAMPLE.iterdir()}
