"""`factorbus datasets` as it is typed."""

import json
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from dataset_sources import Answer, Site, raw_files, written_back

from factorbus.cli.main import main
from factorbus.datasets import CATALOGUE, dataset_named
from factorbus.datasets.places import Places


@pytest.fixture(autouse=True)
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine with an empty cache and no folder of the user's."""
    for name in ("FACTORBUS_DATASETS", "FACTORBUS_DATASETS_URL", "http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "factorbus" / "datasets"


@pytest.fixture
def site() -> Iterator[Site]:
    with raw_files() as site:
        yield site


def serve(site: Site, name: str, content: bytes) -> None:
    source = dataset_named(name, CATALOGUE).download
    assert source is not None
    site.holds(source.repository, source.commit, source.paths[0], Answer(content))


def test_the_list(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["datasets"]) == 0
    shown = capsys.readouterr().out
    assert all(dataset.name in shown for dataset in CATALOGUE)
    assert "546.46111" in shown
    assert "factorbus datasets fetch --all" in shown


def test_the_list_as_json(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, datasets: Path, cache: Path
) -> None:
    monkeypatch.setenv("FACTORBUS_DATASETS", str(datasets))
    assert main(["datasets", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert (listed["own"], listed["cache"]) == (str(datasets), str(cache))
    intel = next(row for row in listed["datasets"] if row["name"] == "intel")
    assert intel["found"] == {"in": "own", "path": str(datasets / "intel.g2o")}
    assert (intel["poses"], intel["edges"], intel["chi2_optimum"], intel["paper"]) == (943, 1837, 546.46111, "Intel")
    assert intel["sources"] == ["github.com/OpenSLAM-org/openslam_g2o at 9675993681, data/2d/intel/intel.g2o"]


def test_fetching_a_real_one_from_a_mirror(
    capsys: pytest.CaptureFixture[str], datasets: Path, site: Site, cache: Path
) -> None:
    serve(site, "manhattan3500", written_back("manhattan3500", datasets))
    assert main(["datasets", "fetch", "manhattan3500", "--from", site.base]) == 0
    assert capsys.readouterr().out == f"{cache / 'manhattan3500.g2o'}\n"
    assert (cache / "manhattan3500.g2o").read_bytes() == (datasets / "manhattan3500.g2o").read_bytes()
    assert main(["datasets", "check", "manhattan3500"]) == 0
    capsys.readouterr()
    assert main(["datasets", "path", "manhattan3500"]) == 0
    assert capsys.readouterr().out == f"{cache / 'manhattan3500.g2o'}\n"
    assert main(["datasets", "path", "manhattan3500", "--json"]) == 0
    path = str(cache / "manhattan3500.g2o")
    assert json.loads(capsys.readouterr().out) == {"name": "manhattan3500", "path": path}


def test_one_failure_does_not_stop_the_others(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, datasets: Path, site: Site, cache: Path
) -> None:
    monkeypatch.setenv("FACTORBUS_DATASETS_URL", site.base)
    serve(site, "intel", b"<html>log in first</html>")
    serve(site, "killian", written_back("killian", datasets))
    assert main(["datasets", "fetch", "intel", "sphere2500", "killian", "--json"]) == 3
    shown = capsys.readouterr()
    rows = json.loads(shown.out)["datasets"]
    assert [row.get("problem", {}).get("code") for row in rows] == ["bad_checksum", "http_status", None]
    assert "2 of 3 could not be fetched" in shown.err
    assert [path.name for path in cache.iterdir()] == ["killian.g2o"]


def test_all_fetches_all(capsys: pytest.CaptureFixture[str], site: Site, cache: Path) -> None:
    assert main(["datasets", "fetch", "--all", "--from", site.base]) == 4
    shipped = 0 if Places.of_this_machine().wheel is None else 2
    assert f"{11 - shipped} of 11 could not be fetched" in capsys.readouterr().err
    assert len(site.asked) == 11 - shipped
    assert len(list(cache.iterdir())) == shipped


@pytest.mark.parametrize(
    ("arguments", "code", "exit_code"),
    [
        (["fetch", "atlantis"], "unknown_dataset", 2),
        (["check", "atlantis"], "unknown_dataset", 2),
        (["path", "atlantis"], "unknown_dataset", 2),
        (["path", "intel"], "not_found", 1),
        (["fetch", "intel", "--from", "nowhere"], "bad_address", 2),
        (["fetch", "intel", "--from", "{site}"], "http_status", 4),
        (["fetch", "intel", "--from", "http://127.0.0.1:1"], "unreachable", 4),
    ],
)
def test_problems_in_one_line(
    capsys: pytest.CaptureFixture[str], site: Site, arguments: list[str], code: str, exit_code: int
) -> None:
    arguments = [word.replace("{site}", site.base) for word in arguments]
    assert main(["datasets", *arguments]) == exit_code
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert shown.err.startswith("factorbus: ")
    assert shown.err.endswith(f" [{code}]\n")


def test_a_cache_that_cannot_be_written(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert main(["datasets", "fetch", "intel", "--from", "http://127.0.0.1:1"]) == 1
    assert capsys.readouterr().err.endswith("[cannot_write]\n")


@pytest.mark.parametrize("arguments", [["fetch"], ["fetch", "intel", "--all"], ["drop"], ["fetch", "--timeout", "0"]])
def test_wrong_use(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    assert main(["datasets", *arguments]) == 2


def test_check_tells_the_damaged_one(capsys: pytest.CaptureFixture[str], datasets: Path, cache: Path) -> None:
    cache.mkdir(parents=True)
    shutil.copyfile(datasets / "intel.g2o", cache / "intel.g2o")
    assert main(["datasets", "check"]) == 0
    with (cache / "intel.g2o").open("a") as file:
        file.write("\n")
    capsys.readouterr()
    assert main(["datasets", "check", "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    states = {row["name"]: row["state"] for row in found["datasets"]}
    assert not found["good"]
    assert (states["intel"], states["killian"]) == ("bad", "missing")
    assert main(["datasets", "check", "killian"]) == 1


def test_ended_in_the_middle_it_leaves_nothing(site: Site, cache: Path) -> None:
    serve(site, "intel", b"EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n" * 9000)
    (answer,) = site.answers.values()
    answer.released, answer.head = threading.Event(), 1 << 17
    command = [sys.executable, "-m", "factorbus.cli", "datasets", "fetch", "intel", "--from", site.base]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert site.visited.wait(60)
        assert [path.name[:7] for path in cache.iterdir()] == [".fetch-"]
        running.send_signal(signal.SIGTERM)
        out, said = running.communicate(timeout=60)
    assert (running.returncode, out) == (130, "")
    assert said.endswith("interrupted\n")
    assert list(cache.iterdir()) == []


def test_a_path_from_the_wheel(capsys: pytest.CaptureFixture[str], cache: Path) -> None:
    if Places.of_this_machine().wheel is None:
        pytest.skip("gtsam is not installed: pip install 'factorbus[bench]'")
    assert main(["datasets", "path", "victoria_park"]) == 0
    assert capsys.readouterr().out == f"{cache / 'victoria_park.g2o'}\n"
    assert main(["datasets", "check", "victoria_park"]) == 0
