"""Rows of `bench peers`: those of `bench paper`, and how they stand against iSAM2 in the same run."""

import statistics
from collections.abc import Sequence
from typing import Any

import numpy as np

from . import summary
from .contestants import ISAM2_ALONE, PEER, SKIPPING, STAND_INS, Entry
from .problems import Problem

Run = dict[str, Any]


def rows_of(
    problem: Problem, entries: Sequence[Entry], runs: dict[str, list[Run]], batch: dict[int, float]
) -> list[dict[str, Any]]:
    """One for each contestant.

    ratio_to_isam2: its time over that of iSAM2's `update()`, medians over the repetitions, both up to the last step
    that both made (ratio_steps), None where one of them made none; ratio_spread: least and largest of a repetition;
    ratio_against: the name of that iSAM2, which is the stand-in where only that went through.
    ratio_to_skip10: the same over that of iSAM2 that relinearizes at every tenth update.
    chi2_ratio_common: chi2_ratio at the samples that iSAM2 has too.  chi2_settled: at the end, iterated until it had
    converged; ours only.
    """
    against, skipping = _peer_of(runs, PEER), _peer_of(runs, SKIPPING)
    peers, rows = [run for run in runs.get(PEER, ()) if run.get("done")], []
    for entry in entries:
        row, mine = summary.row_of(problem, entry, runs[entry.name], batch), runs[entry.name]
        row["chi2_settled"] = mine[0].get("chi2_settled")
        if entry.solver == ISAM2_ALONE:
            row["read_s"] = _median_of([run["facts"].get("read_s") for run in mine])
            row["work"].pop("read_s", None)
        row |= {"ratio_against": against, **_against(mine, runs.get(against, ()))}
        row["ratio_to_skip10"] = _against(mine, runs.get(skipping, ()))["ratio_to_isam2"]
        last = max((step for step, _ in peers[0]["chi2"]), default=-1) if peers else -1
        row["chi2_ratio_common"] = summary.ratio_statistics([s for s in mine[0]["chi2"] if s[0] <= last], batch)
        rows.append(row)
    return rows


def _peer_of(runs: dict[str, list[Run]], peer: str) -> str:
    """Whose time counts: the stand-in's, if it came further."""
    reached = {name: max((r.get("done", 0) for r in runs.get(name, ())), default=0) for name in (peer, STAND_INS[peer])}
    return max(reached, key=reached.__getitem__)


def time_until(run: Run, steps: int) -> float:
    """CPU seconds of the leading steps; between the points of the curve it is taken as straight."""
    if steps >= run["done"]:
        return float(run["cpu_s"])
    return float(np.interp(steps - 1, *run["cumulative"]))


def _against(mine: Sequence[Run], peers: Sequence[Run]) -> dict[str, Any]:
    mine, peers = ([run for run in runs if run.get("done")] for runs in (mine, peers))
    if not mine or not peers:
        return {"ratio_to_isam2": None, "ratio_steps": 0, "ratio_spread": None}
    steps = min(run["done"] for run in (*mine, *peers))
    ours, theirs = ([time_until(run, steps) for run in runs] for runs in (mine, peers))
    each = [a / b for a, b in zip(ours, theirs, strict=False)]
    return {
        "ratio_to_isam2": statistics.median(ours) / statistics.median(theirs),
        "ratio_steps": steps,
        "ratio_spread": [min(each), max(each)],
    }


def _median_of(numbers: Sequence[float | None]) -> float | None:
    known = [number for number in numbers if number is not None]
    return statistics.median(known) if known else None
