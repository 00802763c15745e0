"""`bench large`: bars are held against rows, and the whole command on two small graphs."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from bench import large

LARGE = Path(__file__).parent / "large.py"


def row(poses: int, wall_s: float, **more: Any) -> dict[str, Any]:
    return {"poses": poses, "wall_s": wall_s, "cpu_s": wall_s, "memory_bytes": poses, "chi2": 10.0} | {
        "left": 1e-9, "converged": True, **more
    }  # fmt: skip


def missed(*rows: dict[str, Any]) -> list[str]:
    return [each["what"] for each in large.judged(rows, large.growth(rows)) if not each["met"]]


def test_bars() -> None:
    assert missed(row(100, 1.0), row(10_000, 300.0)) == []
    assert missed(row(100, 1.0), row(10_000, 330.0)) == ["exponent of wall time at most 1.25"]
    assert missed(row(100, 1.0, converged=False)) == ["100 poses: at the optimum"]
    assert missed(row(100, 1.0, left=1e-4)) == ["100 poses: at the optimum"]
    assert missed(row(100, 1.0, gtsam_cpu_s=0.5, gtsam_chi2=10.0)) == ["100 poses: faster than gtsam lm"]
    assert missed(row(100, 1.0, gtsam_cpu_s=0.5, gtsam_chi2=20.0)) == []  # it is elsewhere
    assert large.growth([row(100, 1.0)]) == {}
    assert large.growth([row(100, 1.0), row(1000, 10.0)])["memory_bytes"] == pytest.approx(1.0)


@pytest.mark.timeout(280)
def test_the_command_prints_a_document_and_writes_the_page(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    words = ["--poses", "300,600", "--seed", "3", "--peer-up-to", "300", "--json", f"--page={page}"]
    ran = subprocess.run([sys.executable, str(LARGE), *words], stdout=subprocess.PIPE, check=False)
    assert ran.returncode in (0, 1)
    told = json.loads(ran.stdout)
    small, big = told["rows"]
    assert (small["poses"], big["poses"]) == (300, 600)
    assert small["gtsam_chi2"] == pytest.approx(small["chi2"], rel=1e-3)
    assert "gtsam_cpu_s" not in big
    assert big["converged"]
    assert big["said_bytes"] > 0
    assert set(told["growth"]) == {"cpu_s", "wall_s", "memory_bytes"}
    written = page.read_text()
    assert written.startswith("# Large graphs")
    assert "factorbus bench large --poses 300,600 --seed 3" in written
    assert "| 600 |" in written
