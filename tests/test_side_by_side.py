"""`make test` runs every test once, most of them side by side: none may have a port or a folder to itself."""

import os
import re
import shlex
import subprocess
from pathlib import Path

from longest import FILES, rank

ROOT = Path(__file__).resolve().parents[1]
SIDE_BY_SIDE, ALONE = "not data and not alone", "not data and alone"


def planned(**variables: str) -> list[list[str]]:
    """The arguments of every pytest that `make test` would run."""
    told = [f"{name}={value}" for name, value in variables.items()]
    command = ["make", "--dry-run", "--assume-old=.venv/.ready-dev", "test", *told]
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "ARGS"))}
    made = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60, check=True
    )  # fmt: skip
    lines = [shlex.split(line) for line in made.stdout.splitlines() if " -m pytest " in line]
    return [line[line.index("pytest") + 1 :] for line in lines]


def test_every_test_but_the_long_ones_runs_in_one_of_two_parts() -> None:
    """The two are each other's opposite, and neither leaves out or names a file."""
    beside, alone = planned()
    how = "-n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder"
    assert beside == ["-m", SIDE_BY_SIDE, *how.split()]
    assert alone == ["-m", ALONE]


def test_the_longest_files_begin_first() -> None:
    """By itself the plugin begins with those of the most tests, and ends with one test of a minute."""
    files = [path.relative_to(ROOT) for path in (ROOT / "tests").rglob("test_*.py")]
    begun = sorted((path for path in files if rank(path) < len(FILES)), key=rank)
    assert [path.relative_to("tests").as_posix() for path in begun] == list(FILES)


def test_what_is_asked_for_is_run_one_by_one() -> None:
    assert planned(ARGS="tests/proto -k worked") == [["-m", "not data", "tests/proto", "-k", "worked"]]


def test_no_test_listens_at_a_port_of_its_choice() -> None:
    """Two of them beside each other would not start; 0 is any that is free."""
    fixed = re.compile(r"--listen[\"', =]+(?:tcp|tls|quic|ws)/(?:127\.0\.0\.1|localhost|\[::1\]):[1-9]")
    found = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in sorted((ROOT / "tests").rglob("*.py"))
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if fixed.search(line)
    ]
    assert found == ["tests/ros2/test_ros2_readme.py:51"], "which compares, and starts at others"
