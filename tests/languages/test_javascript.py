"""The JavaScript example: all golden messages, both ways, and a map followed through the gateway."""

import json
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from faulty.other_version import someone_of
from faulty.service import endpoint_in
from processes import Process, processes

from factorbus.client import connect
from factorbus.proto.symbols import format_symbol
from factorbus.simulate import city_trees

ROOT = Path(__file__).parents[2]
EXAMPLE, VECTORS = ROOT / "clients" / "examples" / "js", ROOT / "proto" / "vectors"


def node() -> str:
    """The program, new enough.  Skips where there is none."""
    found = shutil.which("node")
    if found is None:
        pytest.skip("node is not installed: the JavaScript example needs node 20 or newer")
    version = subprocess.run([found, "--version"], capture_output=True, text=True, timeout=30, check=True).stdout
    if int(re.findall(r"\d+", version)[0]) < 20:
        pytest.skip(f"node {version.strip()} is too old: the JavaScript example needs 20 or newer")
    return found


def run(*arguments: str) -> "subprocess.CompletedProcess[str]":
    """In the folder of the example."""
    return subprocess.run([node(), *arguments], cwd=EXAMPLE, capture_output=True, text=True, timeout=120, check=False)


def test_every_golden_message_is_read_and_written() -> None:
    ran = run("vectors.mjs", str(VECTORS))
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout == f"{len(list(VECTORS.rglob('*.msgpack')))} messages read, compared and written\n"


@pytest.mark.parametrize("what", ["bytes", "description"])
def test_a_message_that_differs_is_named(tmp_path: Path, what: str) -> None:
    shutil.copytree(VECTORS, tmp_path / "vectors")
    if what == "bytes":
        file = tmp_path / "vectors" / "delta.msgpack"
        file.write_bytes(file.read_bytes().replace(b"\xca\x7f", b"\xca\x7e").replace(b"previous", b"previouz"))
    else:
        file = tmp_path / "vectors" / "delta.json"
        file.write_text(file.read_text().replace("1.47844444", "1.4784444400000004"))
    ran = run("vectors.mjs", str(tmp_path / "vectors"))
    assert ran.returncode == 1
    assert ran.stderr.startswith("delta.msgpack: ")
    assert "\ndelta" not in ran.stderr[1:]


@pytest.fixture
def spawn(tmp_path: Path) -> Iterator[Callable[..., Process]]:
    with processes(tmp_path) as start:
        yield start


@pytest.mark.timeout(400)
def test_a_map_is_followed_through_the_gateway(spawn: Callable[..., Process]) -> None:
    service = spawn("-m", "factorbus.cli", "serve", "--listen", "tcp/127.0.0.1:0").ready()[0]
    gateway = spawn("-m", "factorbus.cli", "gateway", "--connect", service, "--port", "0").ready()[0]
    with connect(service, client="robot") as bus, bus.map("warehouse") as joined:
        steps = list(city_trees(poses=30, seed=1))
        for step in steps[:10]:
            joined.insert(step.batch)
        joined.wait_converged(60)  # else further steps come in between
        last = joined.estimate.revision + len(steps) - 10
        command = [node(), "--experimental-websocket", "watch.mjs", gateway, "warehouse", str(last)]
        with subprocess.Popen(command, cwd=EXAMPLE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as watch:
            assert watch.stdout is not None
            head = [watch.stdout.readline() for _ in range(2)]
            for step in steps[10:]:
                joined.insert(step.batch)
            said, errors = watch.communicate(timeout=60)
        assert watch.returncode == 0, errors
        assert head[0].startswith("map warehouse: mode bayes-tree, ")
        assert re.match(rf"revision {last - len(steps) + 10}: (\d+) of \1 variables changed", head[1])
        told = json.loads(said.splitlines()[-1].removeprefix("estimate "))
        for keys, values in joined.estimate.snapshot().columns.values():
            for key, value in zip(keys.tolist(), values, strict=True):
                np.testing.assert_array_equal(told.pop(format_symbol(key)), value)
        assert not told
    ran = run("--experimental-websocket", "watch.mjs", gateway, "nowhere")
    assert (ran.returncode, ran.stderr) == (1, "there is no map nowhere; there are: warehouse\n")
    # As its README has it.
    commands = re.findall(r"^```bash\n(.*?)^```$", (EXAMPLE / "README.md").read_text(), re.M | re.S)
    assert [line.split()[1] for line in commands] == ["vectors.mjs", "--experimental-websocket"]
    assert run(*commands[0].split()[1:]).returncode == 0


def test_a_service_of_another_version_is_told_from_silence(spawn: Callable[..., Process], tmp_path: Path) -> None:
    with someone_of("v2", endpoint_in(tmp_path)):
        command = ("-m", "factorbus.cli", "gateway", "--connect", endpoint_in(tmp_path), "--port", "0")
        ran = run("--experimental-websocket", "watch.mjs", spawn(*command).ready()[0], "warehouse")
    assert (ran.returncode, ran.stdout) == (1, "")
    assert "speak version v2 of the protocol, this client v1" in ran.stderr
    assert ran.stderr.endswith(" [other_protocol]\n")
