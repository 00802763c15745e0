"""The import contracts of pyproject.toml hold, and each of them notices when it is broken."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE_ROOTS = ("proto", "service", "workers", "clients")

VIOLATIONS = {
    "The command line is on top": ("clients/factorbus/client", "from factorbus.cli import main"),
    "The wire's words know nothing of ours": ("proto/factorbus/proto", "from factorbus.formats import read"),
    "The solver is pure": ("service/factorbus/solver", "import time"),
    "A journal knows": ("service/factorbus/journal", "from factorbus.service import config"),
    "SQLite is touched": ("service/factorbus/service", "import sqlite3"),
    "The service knows": ("service/factorbus/service", "from factorbus.workers import app"),
    "Workers know": ("workers/factorbus/workers", "from factorbus.service import config"),
    "The mathematics of inverse depth": ("workers/factorbus/idp", "from factorbus.workers import config"),
    "Client, formats and simulated worlds know": ("clients/factorbus/client", "from factorbus.solver import errors"),
    "Client, formats and simulated worlds do not": ("clients/factorbus/simulate", "from factorbus.client import draft"),
    "Pictures need": ("clients/factorbus/viz", "from factorbus.solver import errors"),
    "The gateway is": ("clients/factorbus/gateway", "from factorbus.solver import errors"),
    "The bridge to ROS 2": ("clients/factorbus/ros2", "from factorbus.solver import errors"),
    "Data sets are files": ("clients/factorbus/datasets", "from factorbus.client import draft"),
    "What a front end installs": ("service/factorbus/formats", "import scipy.sparse"),
    "Numba is imported": ("workers/factorbus/workers", "import numba"),
    "Zenoh is touched": ("service/factorbus/service", "import zenoh"),
    "Kernels import": ("service/factorbus/solver/kernels/model", "from factorbus.solver.kernels.sparse import amd"),
    "The solver imports": ("service/factorbus/solver/graph", "from factorbus.solver.sparse import blocks"),
    "The service imports": ("service/factorbus/service/core", "from factorbus.service.maps import host"),
    "Commands import": ("clients/factorbus/cli/output", "from factorbus.cli.commands import serve"),
}


def contracts() -> list[str]:
    content = tomllib.loads((ROOT / "pyproject.toml").read_text())
    return [contract["name"] for contract in content["tool"]["importlinter"]["contracts"]]


def broken_in(folder: Path) -> list[str]:
    """The contracts that the tree in `folder` breaks."""
    roots = os.pathsep.join(str(folder / root) for root in SOURCE_ROOTS)
    ran = subprocess.run(
        [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"],
        cwd=folder, env=os.environ | {"PYTHONPATH": roots}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    broken = [name for name in contracts() if f"{name} BROKEN" in ran.stdout]
    assert f"Contracts: {len(contracts()) - len(broken)} kept, {len(broken)} broken." in ran.stdout, ran.stdout
    assert bool(broken) == bool(ran.returncode)
    return broken


def test_contracts_hold() -> None:
    assert broken_in(ROOT) == []


def test_every_contract_notices_its_violation(tmp_path: Path) -> None:
    """All violations at once, each in a file of its own: reading the tree is what takes the time."""
    for root in SOURCE_ROOTS:
        shutil.copytree(ROOT / root, tmp_path / root, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for number, (folder, line) in enumerate(VIOLATIONS.values()):
        (tmp_path / folder / f"violation{number}.py").write_text(line + "\n")
    assert broken_in(tmp_path) == contracts()


@pytest.mark.parametrize("name", contracts())
def test_every_contract_has_a_violation(name: str) -> None:
    assert any(name.startswith(beginning) for beginning in VIOLATIONS)
