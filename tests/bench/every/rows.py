"""What was seen of drives as rows of numbers."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from bench.replays.chi2 import UNIT

from .follow import Followed, Seen
from .judge import Look

NEAR, FAR = 1.001, 1.01


def row_of(world: str, seed: int, steps: int, found: Followed, isam2: tuple[list[Look], str] | None) -> dict[str, Any]:
    """A drive.  isam2: the same drive by iSAM2, and a note; None: it was not asked.

    `ratios` and `isam2_ratios` are of every step that was judged.
    """
    looks = [seen.look for seen in found.seen]
    row = {
        "world": world,
        "seed": seed,
        "steps": steps,
        "judged": len(looks),
        **spread([look.ratio for look in looks]),
        "unconverged": sum(not seen.report.converged for seen in found.seen),
        "worst_converged": worst_converged([*found.seen, *found.idle]),
        "odometry_excess": max((look.odometry for look in looks), default=0.0),
        "chi2_untrue": max((untruth(seen) for seen in (*found.seen, *found.idle)), default=0.0),
        "idle_steps": len(found.idle),
        "idle_s": found.idle_s,
        "idle_done": found.done,
        "idle_ratio": found.rest.ratio,
        "steps_s": found.steps_s,
        "oracle_off": found.oracle_off,
        "ratios": [look.ratio for look in looks],
    }
    if isam2 is None:
        return row
    theirs, note = isam2
    ratios = [look.ratio for look in theirs]
    odometry = max((look.odometry for look in theirs), default=0.0)
    row |= {**spread(ratios, "isam2_"), "isam2_odometry_excess": odometry}
    return {**row, "isam2_judged": len(ratios), "isam2_note": note, "isam2_ratios": ratios}


def together(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """All drives of a world as one row."""
    ratios = [ratio for row in rows for ratio in row["ratios"]]
    sums = {name: sum(row[name] for row in rows) for name in ("steps", "judged", "unconverged", "steps_s")}
    most = ("worst_converged", "odometry_excess", "chi2_untrue", "idle_steps", "idle_s", "idle_ratio", "oracle_off")
    found = {
        "world": rows[0]["world"],
        "drives": len(rows),
        **sums,
        **spread(ratios),
        **{name: max(row[name] for row in rows) for name in most},
        "idle_done": all(row["idle_done"] for row in rows),
    }
    if theirs := [row for row in rows if "isam2_ratios" in row]:
        found |= spread([ratio for row in theirs for ratio in row["isam2_ratios"]], "isam2_")
        found["isam2_odometry_excess"] = max(row["isam2_odometry_excess"] for row in theirs)
    return found


def spread(ratios: Sequence[float], prefix: str = "") -> dict[str, Any]:
    """Median, 99th percentile and maximum of χ²/χ²_batch; the steps above 1.001 and above 1.01."""
    values = np.array(ratios if len(ratios) else [np.nan])
    p50, p99 = np.percentile(values, (50, 99))
    return {
        f"{prefix}p50": float(p50),
        f"{prefix}p99": float(p99),
        f"{prefix}max": float(values.max()),
        f"{prefix}above_1_001": int((values > NEAR).sum()),
        f"{prefix}above_1_01": int((values > FAR).sum()),
    }


def worst_converged(seen: Sequence[Seen]) -> float:
    """The highest ratio of a step that said `converged`."""
    return max((each.look.ratio for each in seen if each.report.converged), default=1.0)


def untruth(seen: Seen) -> float:
    """How far χ² of a report is from that of the estimate after the step, or before it, as a share of it."""
    pairs = [(seen.report.chi2, seen.look.chi2)]
    if seen.before is not None:
        pairs.append((seen.report.chi2_before, seen.before))
    return max(abs(told - true) / max(true, UNIT) for told, true in pairs)


def far_steps(world: str, seed: int, found: Followed) -> list[dict[str, Any]]:
    """The steps above 1.001, with all that they said."""
    return [
        {
            "world": world,
            "seed": seed,
            "step": seen.step,
            "ratio": seen.look.ratio,
            **seen.look._asdict(),
            "report": {k: v for k, v in seen.report.as_dict().items() if k != "phases_ms"},
        }
        for seen in (*found.seen, *found.idle)
        if seen.look.ratio > NEAR
    ]
