"""What `factorbus top` and `factorbus stats` say of maps that have converged, have not, or gave up."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from faulty.service import MAP, Service, endpoint_in

from factorbus.cli.main import main
from factorbus.cli.output.exits import OK, REFUSED
from factorbus.client.bus import Bus
from factorbus.client.map_row import MapRow

_HISTOGRAM = {"bounds_s": [1.0], "counts": [0, 0], "sum_s": 0.0}
_ROW = {
    "chi2": 12.5, "steps": 7, "inserts": {"accepted": 4, "refused": 0, "busy": 0}, "solver_ms": 1.0, "waiting": 0,
    "parked": 0, "clients": {}, "strategies": {"tree": 7}, "refusals": {}, "step_s": _HISTOGRAM,
    "insert_s": _HISTOGRAM,
}  # fmt: skip
_SERVICE = {
    "service": "s1", "version": "0", "workers": [], "alive": True, "ready": True, "stuck": [], "uptime_s": 5.0,
    "memory": {"resident_bytes": 1 << 20, "limit_bytes": 2 << 20},
}  # fmt: skip
_REASON = "3 further steps in a row changed nothing"
CONVERGED = {"converged": True, "converging": False, "further_steps": 0, "gave_up": ""}
CONVERGING = {"converged": False, "converging": True, "further_steps": 3, "gave_up": ""}
POLISHED = {"converged": True, "converging": True, "further_steps": 2, "gave_up": ""}
GAVE_UP = {"converged": False, "converging": False, "further_steps": 3, "gave_up": _REASON}
NOT_POLISHED = GAVE_UP | {"converged": True}


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    running = Service(tmp_path)
    yield running
    running.close()


def said(service: Service, folder: Path, how: dict[str, Any], capsys: pytest.CaptureFixture[str], *command: str) -> str:
    service.says = _SERVICE | _ROW | how
    service.says["maps"] = [service.row() | {"clients": 0}]
    assert main([*command, "--connect", endpoint_in(folder)]) == OK
    return " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("how", "wanted"),
    [
        (CONVERGED, "12.5 0 0"),
        (CONVERGING, "12.5 converging"),
        (POLISHED, "12.5 converging"),
        (GAVE_UP, "12.5 gave up"),
        (NOT_POLISHED, "12.5 gave up"),
    ],
)
def test_top(service: Service, tmp_path: Path, how: dict[str, Any], wanted: str, capsys: Any) -> None:
    assert wanted in said(service, tmp_path, how, capsys, "top", "--once", "--every", "0.1")


def test_maps_says_how_a_map_is_kept(
    service: Service, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = MapRow("cellar", "bayes-tree", 7, 3, 2, 1)
    kept = replace(plain, name="hall", closures="test", budget_ms=10.0, keep="per_area=2:1,window=50")
    monkeypatch.setattr(Bus, "maps", lambda _: [plain, kept])
    assert main(["maps", "--connect", endpoint_in(tmp_path)]) == OK
    shown = " ".join(capsys.readouterr().out.split())
    assert shown.count("closures tested, steps of 10 ms, keep per_area=2:1,window=50") == 1
    assert shown.count("mode ") == 2


def test_top_as_a_document(service: Service, tmp_path: Path, capsys: Any) -> None:
    (row,) = json.loads(said(service, tmp_path, GAVE_UP, capsys, "top", "--json", "--every", "0.1"))["maps"]
    assert row["name"] == MAP
    assert row.items() >= GAVE_UP.items()


@pytest.mark.parametrize(
    ("how", "wanted"),
    [
        (CONVERGED, "χ² 12.5, converged; 7 tree"),
        (CONVERGING, "χ² 12.5, not converged, converging, after 3 further steps; 7 tree"),
        (POLISHED, "χ² 12.5, converged, converging, after 2 further steps; 7 tree"),
        (
            NOT_POLISHED,
            f"converged to a thousandth of χ²; gave up coming nearer after 3 further steps, as {_REASON}; 7 tree",
        ),
        (GAVE_UP, f"χ² 12.5, not converged after 3 further steps: gave up, as {_REASON}; 7 tree"),
    ],
)
def test_stats(service: Service, tmp_path: Path, how: dict[str, Any], wanted: str, capsys: Any) -> None:
    assert wanted in said(service, tmp_path, how, capsys, "stats")


def test_stats_of_one_map(service: Service, tmp_path: Path, capsys: Any) -> None:
    told = said(service, tmp_path, CONVERGED, capsys, "stats", MAP)
    assert f"map {MAP}" in told
    assert main(["stats", "attic", "--connect", endpoint_in(tmp_path)]) == REFUSED
    assert f"there is no map 'attic' here; there are {MAP}" in capsys.readouterr().err


def test_stats_of_one_map_leave_out_the_others(service: Service, tmp_path: Path, capsys: Any) -> None:
    service.says = _SERVICE | _ROW | CONVERGED
    rows = [service.row() | {"clients": 0}, service.row() | {"clients": 0, "name": "attic"}]
    service.says["maps"] = rows
    service.says["unopened"] = [{"name": "cellar", "state": "damaged", "problem": "a page"}]
    assert main(["stats", "attic", "--json", "--connect", endpoint_in(tmp_path)]) == OK
    (found,) = json.loads(capsys.readouterr().out)["services"]
    assert ([row["name"] for row in found["maps"]], found["unopened"]) == (["attic"], [])
    assert main(["stats", "cellar", "--connect", endpoint_in(tmp_path)]) == OK
    shown = capsys.readouterr().out
    assert "does not open (damaged): a page" in shown
    assert "attic" not in shown
