"""What a newcomer types: wrong things are told apart and said at once, in whatever folder."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import processes

from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, FAILED, OK, REFUSED, UNAVAILABLE, USAGE
from factorbus.cli.output.starts import ratio_to
from factorbus.cli.process.bus import open_bus
from factorbus.client import Draft, connect
from factorbus.formats import read, recoded
from factorbus.proto.problems import NobodyListens
from factorbus.proto.version import __version__

FACTORBUS = str(Path(sys.executable).parent / "factorbus")
RENAMED = ("--letter", "a=c", "--letter", "b=d", "--letter", "=e")
SIGMAS = (0.1, 0.1, 0.02)


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A service with the map `yard` of two robots, of keys without letters, and none else."""
    with processes(tmp_path_factory.mktemp("newcomer")) as start:
        (found,) = start("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--no-warm").ready()
        with connect(found, client="robot", timeout_s=60) as bus, bus.map("yard") as yard:
            for letter in ("a", "b", ""):
                draft = Draft().se2(f"{letter}0", (len(letter), ord(letter or "z"), 0), fixed=True)
                for i in range(1, 4):
                    ends = f"{letter}{i - 1}", f"{letter}{i}"
                    draft.se2(ends[1]).between_se2(*ends, (1, 0, 0), sigmas=SIGMAS)
                yard.insert(draft)
        yield found


def typed(*arguments: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run([FACTORBUS, *arguments], cwd=folder, capture_output=True, text=True, timeout=120, check=False)


def test_version() -> None:
    assert typed("--version").stdout == f"factorbus {__version__}\n"


@pytest.mark.parametrize("example", ["square", "viewer", "async_robot"])
def test_an_example_says_how_it_is_called(example: str) -> None:
    path = Path(__file__).parents[2] / "clients" / "examples" / f"{example}.py"
    said = subprocess.run([sys.executable, str(path), "--help"], capture_output=True, text=True, timeout=60, check=True)
    assert said.stdout.startswith(f"usage: {example}.py [-h] [endpoint] [map]")


@pytest.mark.parametrize(
    "arguments",
    [
        ["ask", "why", "yard", "x1"], ["stats"], ["maps"], ["top", "--once"], ["drop", "yard"],
        ["save", "yard", "a.g2o"],
        ["watch", "yard", "--save", "a.rrd"], ["record", "yard", "--out", "a.mcap"], ["gateway", "--port", "0"],
        ["change", "fix", "yard", "x1"], ["change", "adopt", "yard"], ["change", "fork", "yard", "b"],
        ["change", "merge", "yard", "b"], ["ask", "chi2", "yard", "--batch"], ["budget", "yard", "5"],
        ["plot", "map", "yard"], ["replay", "one.g2o"], ["ros2", "yard"],
    ],
)  # fmt: skip
def test_where_nothing_listens_it_is_said_within_about_a_second(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "one.g2o").write_text("VERTEX_SE2 0 0 0 0\n")
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        nowhere = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        code = main([*arguments, "--connect", nowhere])
    said = capsys.readouterr().err
    assert code == UNAVAILABLE, said
    assert f"nothing listens at {nowhere}; start a service there" in said


def test_where_nothing_listens_it_is_not_said_after_the_day_that_answers_may_take() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(NobodyListens):
            open_bus(f"tcp/127.0.0.1:{taken.getsockname()[1]}", "test", timeout_s=86400)


@pytest.mark.parametrize("arguments", [["ask", "why", "yrad", "x1"], ["drop", "yrad"], ["save", "yrad", "a.g2o"]])
def test_an_unknown_map_names_those_there_are(
    endpoint: str, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, "--connect", endpoint]) == REFUSED
    assert "there is no map 'yrad' here; there are yard; did you mean 'yard'? [unknown_map]" in capsys.readouterr().err


def test_maps_are_listed(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["maps", "--connect", endpoint, "--json"]) == OK
    (row,) = json.loads(capsys.readouterr().out)["maps"]
    assert (row["name"], row["variables"], row["factors"], row["revision"]) == ("yard", 12, 9, 3)


def test_a_map_is_saved_whole_or_the_way_of_each_robot(
    endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def save(*arguments: str) -> list[str]:
        assert main(["save", "yard", *arguments, "--connect", endpoint]) == OK
        return capsys.readouterr().out.split()

    whole, way = tmp_path / "yard.g2o", tmp_path / "way.tum"
    assert save(str(whole)) == [str(whole)]
    assert whole.read_text().count("EDGE_SE2") == 9
    others = [tmp_path / f"yard.{form}" for form in ("pyfg", "jrl", "jrl.cbor")]
    for other in others:
        assert save(str(other)) == [str(other)]
        assert read(other).batch.factor_count == 9
    assert others[2].read_bytes() == recoded(others[1].read_text())
    assert save(str(way), "--robot", "a") == [str(way)]
    assert [float(line.split()[2]) for line in way.read_text().splitlines()] == [97.0] * 4
    each = save(str(tmp_path / "all.kitti"))
    assert each == [str(tmp_path / f"all-{name}.kitti") for name in ("none", "a", "b")]
    assert all(len(Path(path).read_text().splitlines()) == 4 for path in each)
    assert main(["save", "yard", str(way), "--robot", "q", "--connect", endpoint]) == REFUSED
    assert "there are keys without a letter, a, b" in capsys.readouterr().err
    assert main(["save", "yard", str(tmp_path / "a.xyz"), "--connect", endpoint]) == USAGE
    for graph in (whole, *others):
        assert main(["save", "yard", str(graph), "--robot", "a", "--connect", endpoint]) == USAGE
    assert main(["save", "yard", str(others[0]), "--ids", "keys", "--connect", endpoint]) == USAGE
    assert save(str(tmp_path / "counted.g2o"), "--ids", "counted") == [str(tmp_path / "counted.g2o")]
    counted = [int(line.split()[1]) for line in (tmp_path / "counted.g2o").read_text().splitlines() if "VERTEX" in line]
    assert sorted(counted) == list(range(12))
    assert main(["save", "yard", str(way), "--ids", "keys", "--connect", endpoint]) == USAGE


def test_why_of_a_number_is_of_the_factor_and_of_the_variable_without_a_letter(
    endpoint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def why(*arguments: str) -> dict:
        assert main(["ask", "why", "yard", *arguments, "--json", "--connect", endpoint]) == OK
        return json.loads(capsys.readouterr().out)

    both = why("3")
    assert (both["variable"]["key"], both["factor"]["factor"]) == (3, 3)
    assert why("3", "--variable")["factor"] == {}
    assert why("3", "--factor")["variable"] == {}
    assert why("8")["variable"] == {}
    assert main(["ask", "why", "yard", "99", "--connect", endpoint]) == REFUSED
    assert main(["ask", "why", "yard", "x3", "--factor", "--connect", endpoint]) == USAGE
    assert main(["ask", "why", "yard", "9" * 30, "--connect", endpoint]) == USAGE


def test_why_in_python_has_words_and_symbols_and_one_key_will_do(endpoint: str) -> None:
    with connect(endpoint, client="reader") as bus, bus.map("yard", mirror=False, create=False) as yard:
        why = yard.uncertainty.why("a2")
        assert why.symbols == ("a2", "a1", "a3")
        assert str(why) == why.text
        assert why.text.splitlines()[0] == "a2, se2, at revision 3"
        assert "between_se2 (a1, a2): χ²" in why.text
        assert yard.uncertainty.why(factor=0).text.startswith("factor 0, between_se2 (a0, a1)")
        assert yard.uncertainty.covariance("a2")["a2"].shape == (3, 3)
        assert yard.uncertainty.relative(("a1", "a2")).groups[0].covariance.shape == (1, 3, 3)
        assert [group.keys.size for group in yard.ask_estimate("a2").variables] == [1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["ask", "covariance", "yard", "--timeout", "nan"], "not a finite number"),
        (["ask", "covariance", "yard", "--timeout", "-1"], "range"),
        (["change", "weigh", "yard", "nan", "1"], "not a finite number"),
        (["stats", "--timeout", "1e300"], "range"),
        (["replay", "a.g2o", "--pace", "inf"], "not a finite number"),
        (["top", "--every", "nan"], "not a finite number"),
        (["record", "yard", "--out", "nowhere/a.mcap"], "there is no folder nowhere"),
        (["save", "yard", "nowhere/a.g2o"], "there is no folder nowhere"),
    ],
)
def test_numbers_and_places_that_cannot_be_are_refused(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == USAGE
    assert said in capsys.readouterr().err


def test_a_taken_port_has_its_code_and_is_named(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        ran = typed("serve", "--no-warm", "--listen", f"tcp/127.0.0.1:{port}", folder=tmp_path)
        assert (ran.returncode, ran.stdout) == (USAGE, "")
        assert f"tcp/127.0.0.1:{port} is taken: another process listens there" in ran.stderr
        assert "[port_taken]" in ran.stderr
    ran = typed("serve", "--no-warm", "--listen", "tcp/192.0.2.1:7447", "--insecure", folder=tmp_path)
    assert ran.returncode == USAGE
    assert "[cannot_listen]" in ran.stderr


def test_an_import_over_a_map_that_is_there_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "journal" / "hall").mkdir(parents=True)
    (tmp_path / "hall.fbmap").write_text("")
    code = main(["import", str(tmp_path / "hall.fbmap"), "--journal", str(tmp_path / "journal")])
    said = capsys.readouterr().err
    assert code == REFUSED, said
    assert "[map_exists]" in said


def test_an_import_of_a_file_that_no_map_can_be_named_after_says_how_it_gets_a_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, named_otherwise = tmp_path / "hall.fbmap", tmp_path / "my hall.fbmap"
    code = main(["import", str(good), str(named_otherwise), "--journal", str(tmp_path)])
    said = " ".join(capsys.readouterr().err.split())
    assert code == USAGE, said
    assert "my hall.fbmap has a name that no map can have; wanted a name of 1 to 64 of the characters" in said
    assert said.endswith("--as MAP gives it one [bad_usage]")


def test_files_of_the_folder_one_is_in_are_neither_run_nor_in_the_way(tmp_path: Path) -> None:
    for name in (
        "click",
        "numpy",
        "json",
        "zenoh",
        "rich",
        "msgpack",
        "factorbus",
        "numba",
        "logging",
        "typing",
        "queue",
    ):
        (tmp_path / f"{name}.py").write_text("import sys\nsys.exit('poisoned')\n")
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONSAFEPATH")}
    for arguments in (
        ["simulate", "manhattan", "--poses", "12", "--out", "town.g2o"],
        ["replay", "town.g2o", "--every", "4", "--json"],  # a solver and a worker of its own
        ["doctor"],
        ["version"],
    ):
        ran = subprocess.run(
            [FACTORBUS, *arguments],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=280,
            check=False,
        )
        assert ran.returncode in (OK, FAILED if arguments == ["doctor"] else OK), ran.stderr
        assert "poisoned" not in ran.stdout + ran.stderr
        if arguments[0] == "replay":
            assert [each["revision"] for each in json.loads(ran.stdout)["against_batch"]] == [4, 8, 12]


def test_a_map_of_a_file_without_vertices_is_drawn_from_odometry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    edges = [f"EDGE_SE2 {i} {i + 1} 1 0 0.3 100 0 0 100 0 400\n" for i in range(6)]
    (tmp_path / "bare.g2o").write_text("".join(edges))
    assert main(["plot", "map", "bare.g2o"]) == OK
    shown = capsys.readouterr()
    assert "6 poses composed from odometry" in shown.err
    assert (tmp_path / "bare-map.png").stat().st_size > 5000
    assert main(["plot", "map", "nothing.g2o"]) == BAD_FILE


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["ask", "why", "yard", "--", "-5"], "the map has no -5; factorbus ask covariance yard lists those there are"),
        (["ask", "why", "yard", "q5"], "the map has no q5; factorbus ask covariance yard lists those there are"),
        (["ask", "covariance", "yard", "q5"], "the map has no q5; factorbus ask covariance yard lists"),
        (["ask", "why", "yard", "99", "--factor"], "factorbus ask why yard KEY lists those on a variable"),
        (["ask", "gate", "yard", "candidates.g2o"], "there is no variable x5; factorbus ask covariance yard lists"),
        (["change", "remove", "yard", "q5"], "factorbus: there is no variable q5, or not any more; factorbus ask"),
        (["change", "merge", "yard", "yard"], "letter of their own, such as --letter x=y [key_collision]"),
        (["change", "merge", "yard", "yard", *RENAMED], "merged. --absolute leave-out merges it without them"),
        (
            ["change", "merge", "yard", "yard", *RENAMED, "--absolute", "leave-out"],
            "(--anchor x5 y8 0,2,-1.57), or --frame",
        ),
    ],
)
def test_advice_is_that_of_the_command_line(
    endpoint: str,
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "candidates.g2o").write_text("EDGE_SE2 5 6 1 0 0 1 0 0 1 0 1\n")
    assert main([*arguments[:2], "--connect", endpoint, *arguments[2:]]) == REFUSED
    assert said in capsys.readouterr().err


def test_relative_wants_pairs(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ask", "covariance", "yard", "a1", "--relative", "--connect", endpoint]) == USAGE
    assert "--relative wants KEYS in pairs, such as x12 x300; there is 1 key" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("chi2", "batch", "told"),
    [
        (0.0, 0.0, "-"),
        (7e-25, 1e-24, "-"),
        (2.0, 0.0, "above 2e+09"),
        (6168.5, 2e-27, "above 6e+12"),
        (3.0, 2.0, "1.500000000"),
        (1e-3, 1e-8, "100000.000000000"),
    ],
)
def test_what_is_rounding_is_not_compared(chi2: float, batch: float, told: str) -> None:
    assert ratio_to(chi2, batch) == told
