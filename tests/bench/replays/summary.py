"""Rows of the table from runs: medians of the repetitions, and the quality against the optimum along the way."""

import statistics
from collections.abc import Sequence
from typing import Any

import numpy as np

from .chi2 import ratio
from .contestants import Entry
from .problems import Problem

SPIKE = 1.01  # χ²/χ²_batch above which a sample counts as a spike


def row_of(problem: Problem, entry: Entry, runs: Sequence[dict[str, Any]], batch: dict[int, float]) -> dict[str, Any]:
    """One row; `batch` maps steps to χ²_batch.  Times are medians over `runs`, the quality is the first run's."""
    first = runs[0]
    row: dict[str, Any] = {
        "dataset": problem.key,
        "title": problem.label,
        "solver": entry.solver,
        "mode": entry.mode,
        "name": entry.name,
        "status": first["status"],
        "repetitions": len(runs),
        "chi2_final": None,
        "chi2_ratio": {},
    }
    measured = [run for run in runs if run["status"] not in ("crashed",)]
    for name in ("cpu_s", "solve_s", "read_s", "wall_s", "peak_mb", "base_mb", "load_average"):
        row[name] = statistics.median(run[name] for run in measured) if measured else None
    for name in ("step_ms", "solve_ms", "step_wall_ms"):
        row[name] = _medians([run[name] for run in measured])
    row["steps"], row["done"] = first.get("steps"), first.get("done", 0)
    curve = first["chi2"]
    if first["status"] == "done" and curve:
        row["chi2_final"] = curve[-1][1]
    row["chi2_ratio"] = ratio_statistics(curve, batch)
    facts = dict(first["facts"])
    row["nnz_r"], row["strategies"] = facts.pop("nnz_r", None), facts.pop("strategies", {})
    row["work"] = facts
    row["versions"], row["measured_at"] = first.get("versions", {}), first.get("measured_at")
    row["note"] = "; ".join(part for part in (_problem_of(first), entry.remark) if part)
    return row


def ratio_statistics(curve: Sequence[Sequence[float]], batch: dict[int, float]) -> dict[str, float]:
    """median, p95, p99, max, mean of χ²/χ²_batch over the samples, how many there are and how many are spikes."""
    if not curve:
        return {}
    ratios = np.array([ratio(chi2, batch[int(step)]) for step, chi2 in curve])
    return {
        "median": float(np.median(ratios)),
        "p95": float(np.percentile(ratios, 95)),
        "p99": float(np.percentile(ratios, 99)),
        "max": float(ratios.max()),
        "mean": float(ratios.mean()),
        "samples": len(ratios),
        "spikes": int((ratios > SPIKE).sum()),
    }


def best_known(
    problem: Problem, reference: dict[str, Any], runs: Sequence[dict[str, Any]]
) -> tuple[dict[int, float], list[str]]:
    """χ²_batch by step, and what is to be said about it.

    The reference replay settles at every sample; should any contestant stand lower, that was a local minimum, and the
    lower value counts.  Where an optimum is published the last value is held against it.
    """
    batch = {int(step): float(chi2) for step, chi2 in reference["chi2"]}
    last, notes, beaten = max(batch), [], {}
    for run in runs:
        for step, chi2 in run["chi2"]:
            if ratio(chi2, batch[int(step)]) < 1 - 1e-6:
                beaten[int(step)] = run["contestant"]
            batch[int(step)] = min(batch[int(step)], chi2)
    if beaten:
        where = ", ".join(f"{step} ({name})" for step, name in list(beaten.items())[:5])
        notes.append(f"{problem.label}: the reference was a local minimum at {len(beaten)} steps: {where}")
    if problem.optimum is not None:
        off = ratio(batch[last], problem.optimum) - 1
        if abs(off) > 1e-6:
            notes.append(
                f"{problem.label}: the reference ends at {batch[last]:.9g}, {off:+.1e} from the published optimum "
                f"{problem.optimum:.9g}"
            )
    return batch, notes


def optimum_of(problem: Problem, batch: dict[int, float]) -> float:
    """The published optimum; the reference's last value where there is none."""
    return problem.optimum if problem.optimum is not None else batch[max(batch)]


def _problem_of(run: dict[str, Any]) -> str:
    return "" if run["status"] == "done" else f"{run['status'].upper()}: {run['reason']}"


def _medians(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    return {name: statistics.median(row[name] for row in rows) for name in rows[0]} if rows else {}
