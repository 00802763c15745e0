"""Files and folders that this user may not read: the exit code of a bad file, the reason, and what to do."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from factorbus.cli.output.exits import BAD_FILE, REFUSED

_GRAPH = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
_CALLS = """
import contextlib, io, json, sys
from factorbus.cli.main import main
told = []
for arguments in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = main(arguments)
    told.append([code, said.getvalue()])
print(json.dumps(told))
"""
_NO_RIGHTS = "-dac_override,-dac_read_search"


def _called(folder: Path, *commands: str) -> list[tuple[int, str]]:
    """The exit code of each, and what it says, of a user whom permissions hold: root is one without these rights."""
    before: list[str] = []
    if os.geteuid() == 0:
        if shutil.which("setpriv") is None:
            pytest.skip("root reads everything, and there is no setpriv here")
        before = ["setpriv", "--bounding-set", _NO_RIGHTS, "--inh-caps", _NO_RIGHTS]
    calls = json.dumps([command.split() for command in commands])
    ran = subprocess.run(
        [*before, sys.executable, "-P", "-c", _CALLS, calls], cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert ran.returncode == 0, ran.stderr
    return [(code, said) for code, said in json.loads(ran.stdout.splitlines()[-1])]


@pytest.fixture
def shut(tmp_path: Path) -> Iterator[Path]:
    """A folder with a file and a folder that nobody may read, and one that nobody may write to."""
    files, folders = [tmp_path / "shut.g2o", tmp_path / "shut.toml"], [tmp_path / "shut", tmp_path / "fixed"]
    for folder in folders:
        folder.mkdir(mode=0o700)
    for file in (*files, folders[0] / "in.g2o"):
        file.write_text(_GRAPH)
    for path in (*files, folders[0]):
        path.chmod(0)
    folders[1].chmod(0o500)
    yield tmp_path
    for folder in folders:
        folder.chmod(0o700)


def test_what_may_not_be_read_is_a_bad_file_and_says_what_to_do(shut: Path) -> None:
    commands = (
        "replay shut.g2o", "replay shut", "replay shut/in.g2o", "solve shut.g2o", "solve shut/in.g2o",
        "convert shut.g2o out.g2o", "plot map shut.g2o", "access shut.toml", "serve --no-warm --config shut.toml",
        "gateway --people shut.toml", "change merge a b --align shut.g2o", "maps --zenoh shut.toml",
        "serve --no-warm --zenoh shut.toml", "work --zenoh shut.toml", "import fine.fbmap --journal shut/journal",
    )  # fmt: skip
    (shut / "fine.fbmap").write_text("")
    for command, (code, said) in zip(commands, _called(shut, *commands), strict=True):
        assert code == BAD_FILE, (command, said)
        assert "Permission denied" in said, command
        assert "have its owner allow it, chmod a+r" in said, command
        assert said.endswith("[bad_file]\n"), command


def test_a_journal_that_may_not_be_read_is_unreadable(shut: Path) -> None:
    commands = [f"journal {verb} --journal shut" for verb in ("show", "check", "verify")]
    commands += ["export hall --journal shut", "export --all --journal shut"]
    for command, (code, said) in zip(commands, _called(shut, *commands), strict=True):
        assert code == BAD_FILE, (command, said)
        assert "cannot be read (Permission denied); nothing was changed. Look at" in said, command
        assert said.endswith("[journal_unreadable]\n"), command


def test_a_journal_that_may_not_be_written_says_so(shut: Path) -> None:
    commands = [f"serve --no-warm --listen tcp/127.0.0.1:0 --journal {folder}" for folder in ("fixed", "fixed/new")]
    for code, said in _called(shut, *commands):
        assert code == REFUSED
        assert "Permission denied" in said
        assert said.endswith("[journal_failed]\n")
