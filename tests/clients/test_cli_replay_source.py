"""What `factorbus replay` takes: files, and data sets by name."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import pytest

from factorbus.cli.driving.replay_source import source_of
from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, Stopped
from factorbus.datasets import CATALOGUE, Places, dataset_named

GRAPH = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Places:
    """A machine of its own: a folder of the user's, a cache, and no wheel."""
    monkeypatch.chdir(tmp_path)
    for name in ("own", "cache"):
        (tmp_path / name).mkdir()
    return Places(tmp_path / "own", tmp_path / "cache", None)


@pytest.mark.parametrize("folder", ["own", "cache"])
@pytest.mark.parametrize("given", ["intel", "intel.g2o"])
def test_a_name_is_looked_up_where_data_sets_are(places: Places, tmp_path: Path, folder: str, given: str) -> None:
    there = tmp_path / folder / "intel.g2o"
    there.write_text(GRAPH)
    assert source_of(Path(given), places) == there


@pytest.mark.parametrize("given", ["intel", "intel.g2o"])
def test_a_file_of_that_name_comes_first(places: Places, tmp_path: Path, given: str) -> None:
    (tmp_path / "own" / "intel.g2o").write_text(GRAPH)
    Path(given).write_text(GRAPH)
    assert source_of(Path(given), places) == Path(given)


def test_what_only_the_wheel_has_is_converted_into_the_cache(places: Places, tmp_path: Path) -> None:
    toro = b"VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0 1 0 1 1 0 0\n"
    wheel = tmp_path / "Data"
    wheel.mkdir()
    known = dataset_named("w10000_toro", CATALOGUE)
    assert known.wheel is not None
    (wheel / known.wheel.paths[0]).write_bytes(toro)
    source = replace(known.wheel, sha256=(hashlib.sha256(toro).hexdigest(),))
    wrong = replace(known, wheel=source)
    with pytest.raises(Stopped, match="SHA-256") as caught:
        source_of(Path("w10000_toro"), replace(places, wheel=wheel), (wrong,))
    converted = str(caught.value.detail["seen"])
    good = replace(wrong, sha256=converted)
    found = source_of(Path("w10000_toro"), replace(places, wheel=wheel), (good,))
    assert found == tmp_path / "cache" / "w10000_toro.g2o"
    assert "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1" in found.read_text()


@pytest.mark.parametrize(
    ("given", "code", "said"),
    [
        ("intel", "not_found", "no such file, and the data set of that name is not on this machine: "),
        ("intel.g2o", "not_found", "factorbus datasets fetch intel"),
        ("intle", "bad_file", "no such file, and no data set of that name; wanted .* or one of manhattan3500, "),
    ],
)
def test_what_is_neither_is_said_to_be(places: Places, given: str, code: str, said: str) -> None:
    with pytest.raises(Stopped, match=said) as caught:
        source_of(Path(given), places)
    assert (caught.value.code, caught.value.exit_code) == (code, BAD_FILE)


@pytest.mark.parametrize("given", ["intle.g2o", "maps/intel", "w.graph"])
def test_other_paths_are_left_to_who_reads_them(places: Places, tmp_path: Path, given: str) -> None:
    (tmp_path / "own" / "intel.g2o").write_text(GRAPH)
    assert source_of(Path(given), places) == Path(given)


def test_replay_by_name(
    places: Places, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own" / "intel.g2o").write_text(GRAPH)
    monkeypatch.setenv("FACTORBUS_DATASETS", str(tmp_path / "own"))
    assert main(["replay", "intel", "--in-process", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["poses"], result["file"]) == (2, str(tmp_path / "own" / "intel.g2o"))
    assert main(["replay", "intle", "--in-process"]) == BAD_FILE
    assert "no data set of that name" in capsys.readouterr().err


def test_a_plot_of_what_is_no_file_says_how_a_map_on_the_bus_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["plot", "sparsity", "warehouse"]) == BAD_FILE
    assert "the name of a map on the bus, with --connect" in capsys.readouterr().err
