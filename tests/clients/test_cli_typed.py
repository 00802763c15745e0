"""What is typed wrongly, and what cannot be written: refused before the work, and not with an error of Python's."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, FAILED, OK, USAGE
from factorbus.cli.process.options import PICTURES
from factorbus.viz.files import ENDINGS

FACTORBUS = str(Path(sys.executable).parent / "factorbus")
NOWHERE = ("--connect", "tcp/127.0.0.1:9")


def typed(*arguments: str, stdout: object = subprocess.PIPE, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [FACTORBUS, *arguments],
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        timeout=120,
        env=os.environ | environment,
    )


def test_pictures_are_those_that_can_be_drawn() -> None:
    assert PICTURES == ENDINGS


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["simulate", "manhattan", "--truth", "s.kitti"], "s.kitti does not end in .tum"),
        (["simulate", "manhattan", "--out", "s.txt"], "s.txt does not end in .g2o"),
        (["simulate", "manhattan", "--out", "s" * 300 + ".g2o"], "cannot be written: File name too long"),
        (["watch", "m", "--save", "w.txt", *NOWHERE], "w.txt does not end in .rrd"),
        (["record", "m", "--out", "r.txt", *NOWHERE], "r.txt does not end in .mcap"),
        (["demo", "--plot", "x.foo"], "x.foo does not end in .png or .svg or .pdf"),
        (["demo", "monocular", "--plot", "x.foo"], "x.foo does not end in .png or .svg or .pdf"),
        (["replay", "a.g2o", "--plot", "x.foo"], "x.foo does not end in .png or .svg or .pdf"),
        (["convert", "a.g2o", "a.tum", "--ids", "keys"], "--ids is of a .g2o"),
        (["ask", "covariance", "m", "--last", "x1", *NOWHERE], "--last is of the pose inserted last"),
        (["ask", "covariance", "m", "x1", "x2", "--joint", "--relative", *NOWHERE], "--joint and --relative exclude"),
        (["ask", "covariance", "m", "--last", "--relative", *NOWHERE], "--relative and --last exclude each other"),
        (["ask", "covariance", "m", "x1", "x2", "x3", "--relative", *NOWHERE], "x12 x300; there are 3 keys"),
        (["ask", "why", "m", "3", "--variable", "--factor", *NOWHERE], "--variable and --factor exclude each other"),
        (["ask", "repair", "m", "--loss", "dcs", *NOWHERE], "--loss says what --apply does"),
        (["ask", "why", "m", "-1", *NOWHERE], "A number below 0 is written behind `--`"),
        (["replay", "any.mcap", "--map-topics"], "Topics are named by their types: --odom,"),
        (["ros2", "m", "--topic=/odom"], "Topics are named by their types: --odom,"),
        (["change", "weigh", "m", "-1", "3", *NOWHERE], "A number below 0 is written behind `--`"),
        (["change", "loss", "m", "foo", "1", "3", *NOWHERE], "changes: the loss 'foo'; wanted none, or one of huber"),
        (["change", "loss", "m", "dcs", "0", "3", *NOWHERE], "changes: the scale 0.0; wanted finite numbers above 0"),
        (
            ["change", "loss", "m", "dcs:2", "3", *NOWHERE],
            "'dcs:2' is a name and a scale; here they are two words: dcs 2",
        ),
        (
            ["change", "merge", "m", "n", "--anchor", "x0", "y0", "0,0", "--sigmas", "1,1,1", *NOWHERE],
            "--anchor: 0,0 is 2 numbers; wanted x,y,theta or x,y,z,qx,qy,qz,qw",
        ),
        (["ask", "chi2", "m", "--timeout", "soon", *NOWHERE], "'soon' is not a valid number."),
        (["solve", "a.g2o", "--max-iterations", "1.5"], "'1.5' is not a valid integer."),
        (["ros2", "m", "--tolerance", "nan", *NOWHERE], "'nan' is not a finite number"),
        (["ros2", "m", "--display", "-1", *NOWHERE], "-1.0 is not in the range"),
        (["bench"], "Missing argument"),
    ],
)
def test_is_wrong_use_and_says_why(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == USAGE
    shown = capsys.readouterr()
    assert (said in shown.err, shown.out) == (True, ""), shown.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["--upstream", "--journal", "--name"])
def test_an_option_of_serve_that_is_empty_is_not_taken_for_none(
    option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", option, ""]) == USAGE
    assert f"{option} is empty; give a value, or leave the option out" in capsys.readouterr().err


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, full = tmp_path / "town.g2o", {name: tmp_path / f"full.{name}" for name in ("g2o", "tum", "svg")}
    assert main(["simulate", "manhattan", "--poses", "20", "--out", str(source)]) == OK
    for path in full.values():
        path.symlink_to("/dev/full")
    solved = ["replay", str(source), "--in-process"]
    for arguments in (
        ["simulate", "manhattan", "--poses", "20", "--out", str(full["g2o"])],
        ["simulate", "manhattan", "--poses", "20", "--truth", str(full["tum"])],
        ["convert", str(source), str(full["g2o"])],
        [*solved, "--tum", str(full["tum"])],
        [*solved, "--out", str(full["g2o"])],
        [*solved, "--plot", str(full["svg"])],
        ["plot", "map", str(source), "--out", str(full["svg"])],
    ):
        capsys.readouterr()
        assert main(arguments) == FAILED, arguments
        said = capsys.readouterr().err.splitlines()[-1]
        assert said.startswith(
            f"factorbus: {arguments[-1]} cannot be written: No space left on device; make room there"
        )
        assert said.endswith("[cannot_write]")


def test_standard_output_that_is_full_is_said() -> None:
    with open("/dev/full", "w") as full:
        ran = typed("version", stdout=full)
    assert (ran.returncode, ran.stderr) == (
        FAILED,
        "factorbus: standard output cannot be written: No space left on device; "
        "make room where it goes, or send it elsewhere [cannot_write]\n",
    )


@pytest.mark.parametrize("encoding", ["ascii", ""], ids=["named", "of the locale"])
def test_an_encoding_without_our_letters_loses_the_letters_alone(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "a.g2o").write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": encoding}
    ran = typed("replay", str(tmp_path / "a.g2o"), "--in-process", **ascii_only)
    assert ran.returncode == OK, ran.stderr
    assert "|??         | 0, 0 after the last step" in ran.stdout
    assert "strategies" in ran.stdout


def test_kernels_that_cannot_be_kept_are_not_compiled(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    ran = typed("warm", FACTORBUS_CACHE=str(tmp_path / "plain"))
    assert (ran.returncode, ran.stdout) == (FAILED, "")
    assert ran.stderr.startswith(f"factorbus: compiled kernels cannot be kept in {tmp_path / 'plain'}: ")
    assert ran.stderr.endswith(
        "name a folder that can be written with FACTORBUS_CACHE, or make this one so [cannot_write]\n"
    )
    assert len(ran.stderr.splitlines()) == 1


@pytest.mark.parametrize("content", [None, "VERTEX_SE2 0 0 0 0\n"])
def test_a_zenoh_configuration_is_a_file_and_said_to_be_one(content: str | None, tmp_path: Path) -> None:
    path = tmp_path / "ops.json5"
    if content is not None:
        path.write_text(content)
    ran = typed("maps", *NOWHERE, "--zenoh", str(path))
    assert ran.returncode == BAD_FILE
    assert ran.stderr.startswith(f"factorbus: the Zenoh configuration {path} cannot be read: ")
    ran = typed("maps", *NOWHERE, ZENOH_CONFIG=str(path))
    assert ran.returncode == BAD_FILE
    assert ran.stderr.startswith(f"factorbus: the Zenoh configuration {path}, which ZENOH_CONFIG names, cannot be read")
    assert ran.stderr.endswith("[bad_file]\n")


@pytest.mark.parametrize(
    "arguments",
    [
        ("maps", *NOWHERE, "--zenoh"),
        ("serve", "--zenoh"),
        ("serve", "--config"),
        ("solve",),
        ("access",),
        ("gateway", "--people"),
        ("change", "merge", "a", "b", "--align"),
        ("work", *NOWHERE, "--zenoh"),
    ],
)
def test_what_has_no_end_is_not_read(arguments: tuple[str, ...]) -> None:
    ran = typed(*arguments, "/dev/zero")
    assert ran.returncode in (BAD_FILE, USAGE)
    assert "/dev/zero" in ran.stderr
    assert "device" in ran.stderr


@pytest.mark.parametrize(
    "arguments",
    [("solve",), ("replay",), ("plot", "map"), ("journal", "verify", "--journal"), ("export", "m", "--journal")],
)
def test_a_name_that_is_too_long_is_named(arguments: tuple[str, ...]) -> None:
    name = "9" * 400
    ran = typed(*arguments, name)
    assert ran.returncode == BAD_FILE
    assert ran.stderr.endswith("cannot be read: File name too long; name another path [bad_file]\n")
    assert name in ran.stderr


def test_a_graph_without_values_says_what_has_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "town.g2o"
    source.write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    for form in ("tum", "kitti"):
        assert main(["convert", str(source), str(tmp_path / f"town.{form}")]) == BAD_FILE
        assert f"solve it first, as `factorbus replay FILE --{form} OUT` does" in capsys.readouterr().err
    assert main(["replay", str(source), "--in-process"]) == OK
    assert re.search(r"^ *fixed +x0 *$", capsys.readouterr().out, re.M)


@pytest.mark.parametrize("arguments", [["save", "m", "o.foo"], ["replay", "a.g2o", "--every", "-1"], ["nonsense"]])
def test_wrong_use_has_its_code_in_text(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == USAGE
    assert capsys.readouterr().err.endswith("[bad_usage]\n")


def test_a_setting_is_named_as_the_option_and_as_in_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "--no-warm", "--standby"]) == USAGE
    assert 'give --journal DIR, in a file journal = "DIR"' in capsys.readouterr().err


def test_a_journal_that_is_not_there_has_a_next_step(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["journal", "show", "--journal", str(tmp_path / "none")])
    assert "name the folder that `factorbus serve --journal` has [no_journal]" in capsys.readouterr().err
