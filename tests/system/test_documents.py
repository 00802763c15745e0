"""What scripts read: --json of commands that keep, copy, drop and check maps is one document, and what was done."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from journalled import Services, drafts
from processes import PATIENCE_S

from factorbus.cli.main import main
from factorbus.cli.output.exits import FAILED, OK
from factorbus.client import Changes, connect

MAPS = {"hall": 30, "yard": 20}


@pytest.fixture
def ask(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    """Runs a command with --json; its one document."""

    def run(*words: str, code: int = OK) -> dict[str, Any]:
        capsys.readouterr()
        assert main([*words, "--json"]) == code
        return json.loads(capsys.readouterr().out)

    return run


def test_maps_are_saved_budgeted_copied_put_back_checked_and_dropped(
    services: Callable[..., Services], tmp_path: Path, ask: Callable[..., dict[str, Any]]
) -> None:
    journal, backup, other = tmp_path / "journal", tmp_path / "backup", tmp_path / "other"
    running = services(journal)
    endpoint = running.start()
    revisions = {}
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus:
        for name, count in MAPS.items():
            with bus.map(name, window=1) as joined:
                for batch in drafts(count):
                    joined.insert(batch)
                joined.wait_converged()
                revisions[name] = joined.ask_estimate().revision
    at = ("--connect", endpoint)
    untimed = "26 time stamps left out: g2o has no record for the time of se2 variables"
    saved = {"map": "hall", "files": [f"{tmp_path}/hall.g2o"], "notes": [untimed], "left_out": {"time stamps": 26}}
    assert ask("save", "hall", str(tmp_path / "hall.g2o"), *at) == saved
    assert (tmp_path / "hall.g2o").read_text().count("VERTEX_SE2") == MAPS["hall"]
    assert ask("budget", "hall", "5", *at) == {"map": "hall", "budget_ms": 5.0}
    assert ask("budget", "hall", "none", *at) == {"map": "hall", "budget_ms": None}
    assert ask("drop", "nowhere", *at, code=5)["problem"]["code"] == "unknown_map"

    kept = ("--journal", str(journal))
    one = ask("export", "yard", *kept, "--out", str(tmp_path / "yard.fbmap"))["maps"]
    size = (tmp_path / "yard.fbmap").stat().st_size
    assert one == [{"map": "yard", "file": f"{tmp_path}/yard.fbmap", "revision": revisions["yard"], "bytes": size}]
    every = ask("export", "--all", *kept, "--out", str(backup))["maps"]
    assert {row["map"]: row["revision"] for row in every}.items() >= revisions.items()
    checked = ask("journal", "check", "hall", "yard", *kept)["maps"]
    assert checked == [{"map": name, "sound": True, "wrong": []} for name in MAPS]
    verified = ask("journal", "verify", "yard", *kept)["maps"]
    assert verified[0]["differs_from"] is None
    assert verified[0]["revision"] == revisions["yard"]

    other.mkdir()
    put = ask("import", str(backup / "hall.fbmap"), "--journal", str(other), "--as", "hall2")["maps"]
    assert put == [{"map": "hall2", "file": f"{backup}/hall.fbmap", "folder": f"{other}/hall2"}]
    assert ask("drop", "yard", *at) == {"map": "yard", "dropped": True}
    assert "yard" not in [row["name"] for row in ask("maps", *at)["maps"]]


NO_RECORD = {
    "out.g2o": ("g2o has no record for such factors", {"time stamps": 4}),
    "out.pyfg": ("PyFactorGraph (.pyfg) has no record for such factors", {"fixed variables": 1}),
    "out.jrl": ("JRL (.jrl, .jrl.cbor) has no record for such factors", {"fixed variables": 1}),
    "out.cbor": ("JRL (.jrl, .jrl.cbor) has no record for such factors", {"fixed variables": 1}),
}


@pytest.mark.parametrize("file", NO_RECORD)
def test_what_a_file_has_no_record_for_is_in_the_document(
    services: Callable[..., Services],
    tmp_path: Path,
    ask: Callable[..., dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
    file: str,
) -> None:
    why, more = NO_RECORD[file]
    endpoint = services(tmp_path / "journal").start()
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus, bus.map("hall") as joined:
        for batch in drafts(6):
            joined.insert(batch)
        joined.change(Changes().marginalize("x2"))
        kind = joined.graph().batch.factors[-1].kind
    assert kind.startswith("linear_")
    told = ask("save", "hall", str(tmp_path / file), "--connect", endpoint)
    assert told["left_out"] == {kind: 1, **more}
    assert f"1 {kind} left out: {why}" in told["notes"]
    form = why.partition(" has")[0]
    if "fixed variables" in more:
        assert f"1 fixed variable written as free: {form} does not say which variables are fixed" in told["notes"]
    assert main(["save", "hall", str(tmp_path / file), "--connect", endpoint]) == OK
    assert capsys.readouterr().err.splitlines() == [f"{tmp_path / file}: {note}" for note in told["notes"]]


def test_a_map_that_cannot_be_read_is_a_row_with_its_problem(
    services: Callable[..., Services], tmp_path: Path, ask: Callable[..., dict[str, Any]]
) -> None:
    journal = tmp_path / "journal"
    running = services(journal)
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("hall") as joined:
        for batch in drafts(5):
            joined.insert(batch)
    (journal / "broken").mkdir()
    (journal / "broken" / "journal.db").write_bytes(b"no database at all" * 100)
    rows = ask("export", "--all", "--journal", str(journal), "--out", str(tmp_path / "backup"), code=FAILED)["maps"]
    found = {row["map"]: row for row in rows}
    assert found["broken"]["problem"]["code"]
    assert "revision" in found["hall"]
    (row,) = ask("journal", "check", "broken", "--journal", str(journal), code=FAILED)["maps"]
    assert not row["sound"]
    assert row["wrong"]


def test_a_world_and_the_version(tmp_path: Path, ask: Callable[..., dict[str, Any]]) -> None:
    out = str(tmp_path / "town.g2o")
    made = ask("simulate", "manhattan", "--poses", "5", "--seed", "3", "--out", out)
    assert made == {"world": "manhattan", "poses": 5, "seed": 3, "files": [out], "notes": [], "left_out": {}}
    folder = str(tmp_path / "drive")
    drive = ask("simulate", "inertial", "--poses", "4", "--folder", folder)
    assert (drive["files"], drive["notes"], drive["left_out"]) == ([folder], [], {})
    told = ask("version")
    assert set(told) == {"factorbus", "python", "libraries"}
    assert told["libraries"]["numpy"]
