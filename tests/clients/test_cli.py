"""The command line: what it says, how it ends, and how quickly it is there."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from factorbus.cli.main import COMMANDS, main
from factorbus.cli.output.exits import (
    BAD_FILE,
    FAILED,
    INTERRUPTED,
    OK,
    REFUSED,
    UNAVAILABLE,
    USAGE,
    Stopped,
    missing_modules,
    report,
    require,
)
from factorbus.cli.output.installing import install_command, requirement
from factorbus.proto.problems import BadName, Refused, Unavailable
from factorbus.solver import why_stock_numba

FACTORBUS = str(Path(sys.executable).with_name("factorbus"))


def factorbus(*arguments: str, folder: Path | None = None) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([FACTORBUS, *arguments], cwd=folder, capture_output=True, text=True, timeout=100, check=False)


def test_help_names_every_command_without_importing_any() -> None:
    program = "import sys; from factorbus.cli.main import main; main(['--help']); print(*sys.modules, file=sys.stderr)"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=True)
    for name, (module, line) in COMMANDS.items():
        assert (f"  {name} " in ran.stdout) == bool(line)
        assert f"factorbus.cli.{module}" not in ran.stderr.split()
    assert not {"numpy", "zenoh", "rich", "numba", "msgpack", "scipy"} & set(ran.stderr.split())


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_a_real_command_in_it(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, "--help"]) == OK
    text = capsys.readouterr().out
    if COMMANDS[name][1]:
        assert re.search(rf"^  factorbus {name}\b", text, re.M)
    assert max(len(line) for line in text.splitlines()) <= 120


def test_version_names_the_libraries() -> None:
    said = factorbus("version").stdout
    assert re.match(r"factorbus \d+\.\d+\.\d+\n", said)
    assert re.search(r"^  eclipse-zenoh +1\.", said, re.M)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["frobnicate"], USAGE, "there is no command 'frobnicate'; factorbus --help lists"),
        (["stat"], USAGE, "there is no command 'stat'; did you mean 'stats'?"),
        (["fork", "yard", "hall"], USAGE, "there is no command 'fork'; did you mean `factorbus change fork`?"),
        (["covariance", "yard"], USAGE, "did you mean `factorbus ask covariance`?"),
        (["ask", "yard"], USAGE, "The commands of `factorbus ask` are: chi2, components, covariance, "),
        (["plot", "one.g2o"], USAGE, "sparsity, tree. The name of a map or file comes behind one of them"),
        (["replay"], USAGE, "Missing argument 'FILE'"),
        (["replay", "a.g2o", "--in-process", "--connect", "tcp/127.0.0.1:1"], USAGE, "exclude each other"),
        (["replay", "a.g2o", "--out", "nowhere/b.g2o"], USAGE, "there is no folder nowhere; make it first"),
        (["replay", "broken.g2o", "--out", "same"], USAGE, "same does not end in .g2o or .pyfg"),
        (
            ["replay", "broken.g2o", "--in-process", "--plot", "a.gif"],
            USAGE,
            "a.gif does not end in .png or .svg or .pdf",
        ),
        (["serve", "--map", "a b"], USAGE, "map name 'a b' will not do"),
        (["serve", "--listen", "7447"], USAGE, "endpoint '7447' cannot be read; wanted protocol/address, such as"),
        (["serve", "--listen", "tcp/0.0.0.0:99999"], USAGE, "protocol/address with a port from 0 to 65535, such as"),
        (["serve", "--connect", "tcp/127.0.0.1"], USAGE, "[bad_endpoint]"),
        (
            ["replay", "missing.g2o", "--in-process"],
            BAD_FILE,
            "missing.g2o: it cannot be read (No such file or directory)",
        ),
        (["replay", "broken.g2o", "--in-process"], BAD_FILE, "broken.g2o:2: "),
        (["replay", "one.g2o", "--connect", "tcp/127.0.0.1:9", "--timeout", "0.1"], UNAVAILABLE, "[unavailable]"),
        (["replay", "one.g2o", "--connect", "nonsense"], USAGE, "[bad_endpoint]"),
        (["convert", "one.g2o", "one.xyz"], USAGE, "one.xyz does not end in .g2o, .pyfg, .jrl, .cbor, .tum or .kitti"),
        (["convert", "broken.g2o", "one.tum"], BAD_FILE, "broken.g2o:2: "),
        (["simulate", "manhattan"], USAGE, "there is nothing to write"),
        (["simulate", "atlantis", "--out", "a.g2o"], USAGE, "atlantis"),
        (
            ["budget", "yard", "fast"],
            USAGE,
            "'fast' is no number; wanted milliseconds from 0 (no bound) to 60000, such as",
        ),
        (["budget", "yard", "-1"], USAGE, "is -1.0; wanted milliseconds from 0 (no bound) to 60000"),
        (["budget", "yard", "1e400"], USAGE, "is inf; wanted milliseconds from 0 (no bound) to 60000"),
        (["serve", "--config", "missing.toml"], BAD_FILE, "missing.toml cannot be read"),
        (["serve", "--config", "wrong.toml"], USAGE, "'lisen' is not a setting"),
        (["work", "--no-warm", "--connect", "nonsense"], USAGE, "[bad_endpoint]"),
        (["work", "--no-warm", "--connect", "tcp/127.0.0.1"], USAGE, "with a port from 0 to 65535, such as"),
        (["gateway", "--connect", "nonsense"], USAGE, "[bad_endpoint]"),
        (["watch", "m", "--connect", "nonsense"], USAGE, "[bad_endpoint]"),
        (["ask", "chi2", "m", "--connect", "nonsense"], USAGE, "[bad_endpoint]"),
        (["doctor", "--connect", "nonsense"], USAGE, "factorbus: endpoint 'nonsense' cannot be read; wanted"),
    ],
)
def test_ends_with_the_code_and_one_line_that_says_why(
    arguments: list[str], code: int, said: str, tmp_path: Path
) -> None:
    (tmp_path / "one.g2o").write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    (tmp_path / "broken.g2o").write_text("VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1 0 zero 1 0 0 1 0 1\n")
    (tmp_path / "wrong.toml").write_text('lisen = ["tcp/127.0.0.1:0"]\n')
    ran = factorbus(*arguments, folder=tmp_path)
    assert (ran.returncode, ran.stdout) == (code, ""), ran.stderr
    assert said in ran.stderr
    assert "Traceback" not in ran.stderr


def test_with_json_a_failure_is_one_document_too(tmp_path: Path) -> None:
    ran = factorbus("replay", "missing.g2o", "--json", folder=tmp_path)
    assert ran.returncode == BAD_FILE
    problem = json.loads(ran.stdout)["problem"]
    assert problem["code"] == "bad_file"
    assert problem["detail"] == {
        "file": "missing.g2o",
        "line": None,
        "seen": "it cannot be read (No such file or directory)",
        "wanted": "a readable g2o, TORO, iSAM, SLAM++, PyFactorGraph or JRL file; look for its name with ls; a path "
        "that does not begin with / is from the folder you are in",
    }


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    ran = factorbus("--debug", "replay", "missing.g2o", folder=tmp_path)
    assert ran.returncode == BAD_FILE
    assert "Traceback" in ran.stderr


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (Unavailable("x", 1.0, "y"), UNAVAILABLE),
        (Refused("not_finite", "a NaN", {}), REFUSED),
        (Refused("shutting_down", "bye", {}), UNAVAILABLE),
        (BadName("map", "a/b"), USAGE),
        (Stopped("any", "text", BAD_FILE), BAD_FILE),
        (ValueError("text"), FAILED),
    ],
)
def test_errors_lead_to_codes(error: Exception, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert report(error, as_json=False, debug=False) == code
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("factorbus: ")
    assert shown.err.count("\n") == 1


def test_interrupted_is_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("factorbus.cli.main.cli.main", interrupt)
    assert main(["doctor"]) == INTERRUPTED
    assert capsys.readouterr().err == "interrupted\n"


def test_a_missing_extra_is_named_with_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("factorbus.cli.output.exits.find_spec", lambda name: None if name == "numba" else object())
    assert missing_modules("service") == ["numba"]
    require("viz", "a picture")
    with pytest.raises(Stopped, match=r"factorbus serve needs numba.*: \S.* install .*\[service\]"):
        require("service", "factorbus serve")


@pytest.mark.parametrize(
    ("told", "wanted"),
    [
        ({}, "'factorbus[watch,viz]'"),
        ({"url": "file:///a%20b/c", "dir_info": {"editable": True}}, "-e '/a b/c[watch,viz]'"),
        ({"url": "file:///a", "dir_info": {}}, "'/a[watch,viz]'"),
        ({"url": "file:///f.whl", "archive_info": {}}, "'factorbus[watch,viz] @ file:///f.whl'"),
        (
            {"url": "https://h/f.git", "vcs_info": {"vcs": "git", "commit_id": "ab12"}},
            "'factorbus[watch,viz] @ git+https://h/f.git@ab12'",
        ),
    ],
)
def test_what_pip_is_to_install_is_where_this_copy_is_from(told: dict, wanted: str) -> None:
    assert requirement(("watch", "viz"), told) == wanted


def test_the_command_that_installs_an_extra_is_for_this_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = {"url": tmp_path.as_uri(), "dir_info": {"editable": True}}
    monkeypatch.setattr("factorbus.cli.output.installing.origin", lambda: told)
    monkeypatch.setattr("sys.executable", str(tmp_path / ".venv" / "bin" / "python"))
    monkeypatch.chdir(tmp_path)
    assert install_command("watch") == ".venv/bin/python -m pip install -e '.[watch]'"
    monkeypatch.setattr("shutil.which", lambda name: str(tmp_path / ".venv" / "bin" / name))
    assert install_command("watch") == "pip install -e '.[watch]'"


def test_simulate_writes_what_convert_and_read_understand(tmp_path: Path) -> None:
    from factorbus.formats import read

    made = factorbus("simulate", "city-trees", "--poses", "300", "--out", "c.g2o", "--truth", "c.tum", folder=tmp_path)
    assert (made.returncode, made.stdout) == (OK, ""), made.stderr
    graph = read(tmp_path / "c.g2o")
    assert graph.poses == 300
    assert graph.landmarks > 0
    assert len((tmp_path / "c.tum").read_text().splitlines()) == 300
    again = factorbus("convert", "c.g2o", "d.g2o", folder=tmp_path)
    assert again.returncode == OK, again.stderr
    assert (tmp_path / "d.g2o").read_text() == (tmp_path / "c.g2o").read_text()


def test_doctor_in_json_finds_this_machine_fit(tmp_path: Path) -> None:
    ran = subprocess.run(
        [FACTORBUS, "doctor", "--json"],
        env=os.environ | {"FACTORBUS_CACHE": str(tmp_path)},
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    found = json.loads(ran.stdout)
    checks = {each["name"]: each for each in found["checks"]}
    assert found["healthy"], checks
    assert ran.returncode == OK
    assert set(checks) == {
        "python", "libraries", "extras", "cholmod", "numba", "kernel cache", "machine", "clock", "wall clock",
        "shared memory", "permissions", "port", "bus",
    }  # fmt: skip
    assert checks["kernel cache"]["state"] == "warn"
    assert checks["kernel cache"]["mend"] == "factorbus warm compiles ahead"
    assert "CHOLMOD" in checks["cholmod"]["seen"]
    assert "answers on loopback" in checks["bus"]["seen"]
    assert not [path for path in tmp_path.rglob("*") if path.is_file()], "it has compiled nothing"


def test_doctor_says_why_numba_is_used_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    from factorbus.cli.doctor import checks

    assert why_stock_numba() == ""
    assert checks.numba().state == "ok"
    monkeypatch.setenv("FACTORBUS_STOCK_NUMBA", "1")
    found = checks.numba()
    assert (found.state, found.mend) == ("warn", "unset FACTORBUS_STOCK_NUMBA")
    assert "as it is: FACTORBUS_STOCK_NUMBA is 1" in found.seen
    monkeypatch.delenv("FACTORBUS_STOCK_NUMBA")
    monkeypatch.setattr("factorbus.solver.kernels.jit.releases.version", lambda _: "0.68.99")
    found = checks.numba()
    assert found.state == "warn"
    assert "numba 0.68.99 is not one of those tested (0.68.1)" in found.seen
    monkeypatch.setenv("FACTORBUS_STOCK_NUMBA", "yes")
    with pytest.raises(ValueError, match="FACTORBUS_STOCK_NUMBA is 'yes'; wanted 1"):
        why_stock_numba()


def test_doctor_names_the_extras_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    from factorbus.cli.doctor import checks

    monkeypatch.setattr("factorbus.cli.output.exits.find_spec", lambda name: None if name == "rerun" else object())
    found = checks.extras()
    assert found.state == "ok"
    assert re.fullmatch(r"if wanted: \S.* install .*\[watch\]'", found.mend)
    assert "without watch" in found.seen
    monkeypatch.setattr("factorbus.cli.output.exits.find_spec", lambda _: None)
    assert checks.extras().seen == "none installed; without service, cholmod, metis, viz, watch, record, gateway, ros2"


@pytest.mark.parametrize(("answer", "state"), [(0, "ok"), (5, "warn"), (-1, "ok")])
def test_doctor_asks_the_kernel_who_keeps_the_clock(answer: int, state: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from factorbus.cli.doctor import checks

    class Libc:
        @staticmethod
        def adjtimex(_: object) -> int:
            return answer

    monkeypatch.setattr(checks.ctypes, "CDLL", lambda _: Libc)
    assert checks.wall_clock().state == state


def test_extras_are_those_of_the_project() -> None:
    """What the commands ask for is what `pip install 'factorbus[...]'` brings."""
    import tomllib

    from factorbus.cli.output.exits import EXTRAS

    project = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text())["project"]
    distributions = {
        "prometheus_client": "prometheus-client",
        "sksparse": "scikit-sparse",
        "rerun": "rerun-sdk",
        "foxglove": "foxglove-sdk",
    }
    for extra, names in EXTRAS.items():
        brought = {re.split(r"[<>=\[]", each)[0] for each in project["optional-dependencies"][extra]}
        assert {distributions.get(name, name) for name in names} <= brought


def test_doctor_fails_where_kernels_cannot_be_kept(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    ran = subprocess.run(
        [FACTORBUS, "doctor"],
        env=os.environ | {"FACTORBUS_CACHE": str(tmp_path / "file")},
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert ran.returncode == FAILED
    assert "make it writable, or set FACTORBUS_CACHE" in ran.stdout


def test_warm_says_how_long(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["warm"]) == OK
    assert re.search(r"kernels ready in \d+\.\d s", capfd.readouterr().out)
    assert main(["warm", "--json"]) == OK
    document = json.loads(capfd.readouterr().out)
    assert set(document) == {"seconds", "compiling_seconds", "compiled"}
    assert document["compiled"] == [], "the second time it only loads them"
