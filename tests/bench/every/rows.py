"""What was seen of a drive as a row of numbers."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .follow import Followed, Seen
from .judge import Look


def spread(looks: Sequence[Look], prefix: str = "") -> dict[str, Any]:
    """p50, p99, max of χ²/χ²_batch, the steps above 1.001 and 1.01, and the worst new odometry factor."""
    ratios = np.array([look.ratio for look in looks])
    p50, p99 = np.percentile(ratios, (50, 99)) if len(ratios) else (None, None)
    return {
        f"{prefix}p50": p50,
        f"{prefix}p99": p99,
        f"{prefix}max": ratios.max(initial=1.0),
        f"{prefix}above_1_001": int((ratios > 1.001).sum()),
        f"{prefix}above_1_01": int((ratios > 1.01).sum()),
        f"{prefix}odometry_excess": max((look.odometry for look in looks), default=0.0),
    }


def row_of(world: str, seed: int, found: Followed) -> dict[str, Any]:
    """Ours."""
    rest = found.rest
    settled = rest.looks[-1].ratio if rest and rest.looks else 1.0
    said = [seen.look.ratio for seen in found.seen if seen.report.converged]
    return {
        "world": world,
        "seed": seed,
        "steps": len(found.seen),
        **spread([seen.look for seen in found.seen]),
        "unconverged": sum(not seen.report.converged for seen in found.seen),
        "worst_converged": max([*said, rest.untrue if rest else 1.0]),
        "chi2_untrue": max((untruth(seen) for seen in found.seen), default=0.0),
        "idle_steps": rest.steps if rest else 0,
        "idle_s": rest.seconds if rest else 0.0,
        "idle_done": bool(rest and rest.done),
        "idle_ratio": settled,
        "seconds": found.seconds,
    }


def untruth(seen: Seen) -> float:
    """How far the χ² of a report is from that of the estimate, as a share of it."""
    return abs(seen.report.chi2 - seen.look.chi2) / max(seen.look.chi2, 1e-3)


def bad_steps(world: str, seed: int, found: Followed) -> list[dict[str, Any]]:
    """The steps above 1.001, and those that told another χ² than that of their estimate, in full."""
    return [
        {
            "world": world,
            "seed": seed,
            "step": seen.step,
            "ratio": seen.look.ratio,
            "chi2": seen.look.chi2,
            "optimum": seen.look.optimum,
            "odometry_excess": seen.look.odometry,
            "passes": seen.look.passes,
            "report": {k: v for k, v in seen.report.as_dict().items() if k != "phases_ms"},
        }
        for seen in found.seen
        if seen.look.ratio > 1.001
    ]
