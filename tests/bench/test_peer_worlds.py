"""What `bench peers` makes of worlds, and the page of results."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench.peer_runs import BATCH, a_run
from bench.replays import peer_summary, results_page, world_targets
from bench.replays.contestants import ENTRIES, PEER, SKIPPING, STAND_INS
from bench.replays.problems import Problem, drawn, load
from bench.replays.targets import MET, MISSED
from bench.replays.worlds import WORLDS

from factorbus.proto import codec
from factorbus.proto.messages import Batch, Insert
from factorbus.solver import Options, Solver

DIMS = {"se2": 3, "se3": 6, "point2": 2}
RESIDUALS = {"between_se2": 3, "between_se3": 6, "landmark_se2": 2}


def test_the_page_of_results_has_a_line_a_data_set_and_what_was_missed(tmp_path: Path) -> None:
    entries, gave_up = ("auto", PEER, STAND_INS[PEER], SKIPPING), {"status": "failed", "reason": "step 150"}
    at = {"versions": {"gtsam": "4.3.0"}, "measured_at": "2026-02-03T04:05:06Z", "chi2_settled": 10.0}
    runs = {name: [a_run(name, seconds, **at)] for name, seconds in zip(entries, (1.0, 3.0, 7.0, 12.0), strict=True)}
    runs[PEER] = [a_run(PEER, 3.0, 150, **at, **gave_up)]
    rows = peer_summary.rows_of(Problem("intel", "Intel"), [ENTRIES[name] for name in entries], runs, BATCH)
    document = {
        "machine": {"cpu": "a processor", "cores": 2}, "rows": rows, "judged": "auto", "notes": ["a note"],
        "over_bus": {"intel": {"insert_ms": {"p50": 0.41, "p99": 1.23}}},
        "targets": [
            {"what": "w", "seen": "s", "verdict": MET}, {"what": "x", "seen": "y", "verdict": MISSED},
            {"what": "geometric mean", "seen": "9.5", "verdict": MET},
        ],
    }  # fmt: skip
    text = results_page.page(document, ["--only", "intel", "--out", str(tmp_path), "--seed", "3"])
    line = "| intel | 300 | 1 s | 7 s (7.0 ×) | 12 s (12.0 ×) | 0.10, 0.3 ms | 1.0000 | 1.0000 | 1.0000 | 0.4, 1.2 ms |"
    assert line in text.splitlines()
    assert (
        "`factorbus bench peers --only intel --seed 3` found, on 2026-02-03, on one core: a processor (2 cores)" in text
    )
    assert "2 of 3 targets are met" in text
    assert "- met: geometric mean: 9.5" in text
    assert "w: s" not in text
    assert "- MISSED: x: y" in text
    assert "> a note" in text
    assert "Simulated worlds" not in text


def world_rows(**more: float) -> tuple[list[dict[str, Any]], list[Problem]]:
    """Of all worlds, ours eleven times as fast as iSAM2; more: by key, how much faster that is."""
    worlds, found = drawn(77, 300), list[dict[str, Any]]()
    for each in worlds:
        peer = {name: [a_run(name, 11.0 * more.get(each.key, 1.0))] for name in (PEER, SKIPPING)}
        runs = {"auto": [a_run("auto", chi2_settled=10.0)], **peer}
        found += peer_summary.rows_of(each, [ENTRIES["auto"]], runs, BATCH)
    return found, worlds


def test_worlds_are_judged_by_half_and_by_how_far_the_halves_are_apart() -> None:
    verdicts = world_targets.judge_worlds(*world_rows())
    assert len(verdicts) == 7
    assert {v.verdict for v in verdicts} == {MET}
    drawn_here = {each.key: 0.8 for each in drawn(77, 300) if each.seed == 77}
    missed = [v for v in world_targets.judge_worlds(*world_rows(**drawn_here)) if v.verdict == MISSED]
    assert [v.seen for v in missed] == ["8.80, least 8.80 (manhattan-300-77)", "1.25 x"]
    slow = [v for v in world_targets.judge_worlds(*world_rows(**{"torus-300-1": 0.26})) if v.verdict == MISSED]
    assert [v.seen.split(", ")[1] for v in slow] == ["least 2.86 (torus-300-1)"] * 2
    assert world_targets.judge_worlds([], []) == []


@pytest.mark.parametrize("name", sorted(WORLDS))
def test_a_world_is_drawn_from_its_seed_and_fits_its_truth(name: str) -> None:
    first, again, other = (load(Problem(name, name, 130, None, seed)) for seed in (3, 3, 4))
    assert messages(first) == messages(again) != messages(other)
    assert len(first) == 130
    solver = Solver(Options())
    for batch in first:
        solver.stage(batch)
        solver.step()
    solver.step(settle=True)
    factors = [group for batch in first for group in batch.factors]
    residuals = sum(RESIDUALS[group.kind] * len(group.keys) for group in factors)
    variables = [group for batch in first for group in batch.variables if not group.fixed]
    freedom = residuals - sum(DIMS[group.kind] * len(group.keys) for group in variables)
    assert freedom > 20
    assert abs(solver.chi2() - freedom) < 5.0 * np.sqrt(2.0 * freedom), "χ² of as many degrees of freedom"


def messages(batches: Sequence[Batch]) -> list[bytes]:
    return [codec.encode_insert(Insert(1, batch)) for batch in batches]
