"""Every block of code in the README runs, as it stands there."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ENDPOINT = "tcp/127.0.0.1:7447"
SCRIPTS = Path(sys.executable).parent


def blocks(document: str) -> list[tuple[str, str]]:
    """(language, text) of the fenced blocks of a document, in order."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", (ROOT / document).read_text(encoding="utf-8"), re.M | re.S)


def run(arguments: list[str], folder: Path, timeout_s: float = 100) -> str:
    environment = os.environ | {"PATH": f"{SCRIPTS}{os.pathsep}{os.environ['PATH']}"}
    ran = subprocess.run(
        arguments, cwd=folder, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False
    )
    assert ran.returncode == 0, f"{arguments} ended with {ran.returncode}\n{ran.stdout}\n{ran.stderr}"
    return ran.stdout


@contextmanager
def serving(command: str) -> Iterator[str]:
    """The README's `factorbus serve` on a free port, as long as it is needed; gives the endpoint."""
    arguments = [str(SCRIPTS / command.split()[0]), *command.split()[1:], "--listen", "tcp/127.0.0.1:0", "--until-eof"]
    with subprocess.Popen(
        arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        ready = process.stdout.readline().split()
        assert ready[0] == "ready"
        yield ready[1]
        process.stdin.close()
        assert process.wait(30) == 0


def test_the_blocks_are_those_that_the_tests_below_run() -> None:
    kinds = [(language, text.split("\n")[0]) for language, text in blocks("README.md")]
    assert kinds == [
        ("bash", "make demo"),
        ("bash", "factorbus simulate manhattan --poses 1000 --out town.g2o"),
        ("bash", "factorbus serve"),
        ("python", "from factorbus.client import Draft, connect"),
    ]


@pytest.mark.timeout(300)
def test_make_demo() -> None:
    """In the repository, where set-up has been made; only the virtual environment is that of the tests."""
    text = blocks("README.md")[0][1].strip()
    environment = str(SCRIPTS.parent)
    said = run([*text.split(), f"VENV={environment}", f"--assume-old={environment}/.ready"], ROOT, timeout_s=280)
    assert "every one: 2,000 steps, 2,000 by the robot, 2,000 by the viewer" in said
    assert (ROOT / "out" / "demo.png").stat().st_size > 20_000


def test_simulate_and_replay(tmp_path: Path) -> None:
    said = run(["bash", "-euo", "pipefail", "-c", blocks("README.md")[1][1]], tmp_path)
    assert "1000 poses" in said
    assert said.count("χ² / batch at") == 5
    assert {"town.g2o", "town.png", "town.tum"} == {path.name for path in tmp_path.iterdir()}
    assert len((tmp_path / "town.tum").read_text().splitlines()) == 1000


def test_ten_lines_of_client_against_factorbus_serve(tmp_path: Path) -> None:
    (_, serve), (_, program) = blocks("README.md")[2:]
    assert ENDPOINT in program
    with serving(serve.strip()) as endpoint:
        said = run([sys.executable, "-c", program.replace(ENDPOINT, endpoint)], tmp_path)
    before, after = (line.split("at", 1)[1] for line in said.splitlines())
    assert distance(before) > 0.05
    assert distance(after) < distance(before) / 10


def test_make_targets_of_contributing_exist() -> None:
    named = re.findall(r"make ([a-z-]+)", (ROOT / "CONTRIBUTING.md").read_text() + (ROOT / "README.md").read_text())
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M)
    assert set(named) <= set(targets)


def test_commands_of_the_table_are_all_there_are() -> None:
    from factorbus.cli.main import COMMANDS

    told = re.findall(r"^\| `factorbus ([a-z0-9]+)", (ROOT / "README.md").read_text(), re.M)
    assert set(told) == set(COMMANDS) - {"robot", "version"}


def distance(said: str) -> float:
    """From the origin, of the first `[x y ...]` in what was printed."""
    x, y = (float(number) for number in said[said.index("[") + 1 :].replace("]", " ").split()[:2])
    return (x * x + y * y) ** 0.5
