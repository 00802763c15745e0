"""Set-up says exactly what is missing and how to get it; what is deployed is what the program reads."""

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from factorbus.cli.main import main
from factorbus.service.config import load_config

ROOT = Path(__file__).resolve().parents[1]


def run(script: str, *arguments: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        ["bash", str(ROOT / "deploy/setup" / script), *arguments],
        env=os.environ | {"FACTORBUS_NO_SYSTEM": "1"} | environment,
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


def test_nothing_is_missing_where_these_tests_run() -> None:
    for script in ("system.sh", "cholmod.sh"):
        ran = run(script, "python3")
        assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", "")


def test_what_is_missing_is_named_with_how_to_install_it(tmp_path: Path) -> None:
    """An interpreter that has neither headers nor venv, and a PATH with no compiler."""
    python = tmp_path / "python3"
    python.write_text("#!/bin/sh\nexit 1\n")
    python.chmod(0o755)
    for tool in ("bash", "cat", "id"):
        (tmp_path / tool).symlink_to(shutil.which(tool) or "")
    ran = run("system.sh", "python3", PATH=str(tmp_path))
    assert ran.returncode == 1
    for text in ("missing on this machine: Python's venv and ensurepip modules", "sudo apt-get install python3-venv"):
        assert text in ran.stderr
    ran = run("cholmod.sh", "python3", PATH=str(tmp_path))
    assert ran.returncode == 1
    for text in (
        "a C compiler; Python's headers (Python.h)",
        'everything but backend="cholmod" works without it',
        "sudo apt-get install build-essential python3-dev libsuitesparse-dev",
        "sudo dnf install gcc python3-devel suitesparse-devel",
        "sudo pacman -S --needed base-devel suitesparse",
        "brew install suite-sparse",
    ):
        assert text in ran.stderr


def test_without_a_browser_set_up_goes_on_and_says_what_that_costs(tmp_path: Path) -> None:
    for tool in ("bash", "id"):
        (tmp_path / tool).symlink_to(shutil.which(tool) or "")
    ran = run("browser.sh", PATH=str(tmp_path))
    assert ran.returncode == 0
    assert "there is no Chromium: the tests that look at pages will be skipped (apt-get install chromium)" in ran.stderr
    (tmp_path / "chromium").symlink_to("/bin/true")
    assert run("browser.sh", PATH=str(tmp_path)).stderr == ""


def test_an_interpreter_that_is_too_old_or_not_there_is_named(tmp_path: Path) -> None:
    ran = run("environment.sh", str(tmp_path / "venv"), "dev", PYTHON="/nowhere/python3.9")
    assert ran.returncode == 1
    assert "found no Python 3.11 or newer (looked for: /nowhere/python3.9)" in ran.stderr
    assert not (tmp_path / "venv").exists()


def test_set_up_runs_again_only_when_what_is_installed_has_changed(tmp_path: Path) -> None:
    """make decides by the stamp: nothing to do after it, pip again after a change of pyproject.toml."""
    for name in ("Makefile", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    shutil.copytree(ROOT / "deploy/setup", tmp_path / "deploy/setup")

    def planned() -> str:
        made = subprocess.run(
            ["make", "--dry-run", "setup"], cwd=tmp_path, capture_output=True, text=True, timeout=30, check=True
        )
        return made.stdout

    assert "deploy/setup/environment.sh .venv service,metis,viz," in planned()
    stamp = tmp_path / ".venv" / ".ready-dev"
    stamp.parent.mkdir()
    stamp.touch()
    assert "environment.sh" not in planned()
    later = stamp.stat().st_mtime_ns + 10**9
    os.utime(tmp_path / "pyproject.toml", ns=(later, later))
    assert "environment.sh" in planned()


def test_the_deployed_configuration_is_one_that_serve_takes() -> None:
    config = load_config(ROOT / "deploy/systemd/serve.toml", insecure=True)
    assert config.listen == ("tcp/127.0.0.1:7447",)


@pytest.mark.parametrize("unit", ["factorbus.service", "factorbus-worker.service"])
def test_units_call_commands_that_exist_with_options_they_have(unit: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "deploy/systemd" / unit).read_text()
    for command, options in re.findall(r"^Exec\w+=\S*/factorbus (\w+)(.*)$", text, re.M):
        assert main([command, "--help"]) == 0
        shown = capsys.readouterr().out
        assert all(option in shown for option in re.findall(r"--[a-z-]+", options))


@pytest.mark.parametrize(
    ("told", "driven"),
    [
        (["FILE=my town.g2o"], ["replay", "my town.g2o", "--live"]),
        (["FILE=~/town.g2o"], ["replay", "/home/somebody/town.g2o", "--live"]),
        (["FILE=town.g2o", "ARGS=--pace 10"], ["replay", "town.g2o", "--live", "--pace", "10"]),
        ([], ["replay", "--live"]),
    ],
    ids=["space", "home", "options", "none"],
)
def test_make_live_takes_any_path(told: list[str], driven: list[str]) -> None:
    ran = subprocess.run(
        ["make", "--no-print-directory", "--dry-run", "--assume-old=.venv/.ready", "live", *told],
        cwd=ROOT, env=os.environ | {"HOME": "/home/somebody"}, capture_output=True, text=True, timeout=30, check=True,
    )  # fmt: skip
    assert shlex.split(ran.stdout.splitlines()[-1])[1:] == driven
