"""What `bench peers` must show on worlds: the same with seeds that were looked at as with those drawn for the run."""

import math
from collections.abc import Sequence
from typing import Any

from .peer_targets import MEAN_TIMES, MEAN_TIMES_SKIP10, OURS, QUALITY, QUALITY_WORDS, times_faster, verdict
from .problems import LOOKED_AT, Problem
from .targets import NOT_MEASURED, Verdict

LEAST_TIMES, LEAST_TIMES_SKIP10 = 4.0, 3.0
GAP = 1.2  # between the means of both halves


def judge_worlds(rows: Sequence[dict[str, Any]], worlds: Sequence[Problem], judged: str = OURS) -> list[Verdict]:
    """Both halves, and how far they are apart.  judged: the contestant that is to show it."""
    if not worlds:
        return []
    ours = {row["dataset"]: row for row in rows if row["name"] == judged}
    found, means = list[Verdict](), list[float]()
    for words, keys in (
        ("worlds that were looked at", [each.key for each in worlds if each.seed == LOOKED_AT]),
        ("worlds drawn for this run", [each.key for each in worlds if each.seed != LOOKED_AT]),
    ):
        mine = [ours[key] for key in keys if key in ours]
        for name, peer, mean, least in (
            ("ratio_to_isam2", "iSAM2", MEAN_TIMES, LEAST_TIMES),
            ("ratio_to_skip10", "iSAM2 with skip 10", MEAN_TIMES_SKIP10, LEAST_TIMES_SKIP10),
        ):
            found += _faster(f"{words}: {peer}'s time over ours", mine, name, mean, least)
        means += [_mean([row["ratio_to_isam2"] for row in mine])]
        found.append(_quality(words, mine))
    gap = max(means) / min(means) if all(means) else math.nan
    what = f"{worlds[0].poses} poses: what was not looked at is within {GAP - 1:.0%} of what was"
    return [*found, verdict(what, f"{gap:.2f} x", gap <= GAP)]


def _faster(what: str, rows: Sequence[dict[str, Any]], name: str, mean: float, least: float) -> list[Verdict]:
    what = f"{what}: geometric mean at least {mean:g}, least at least {least:g}"
    times = {row["dataset"]: each for row in rows if (each := times_faster(row, name))}
    if not times:
        return [Verdict(what, "", NOT_MEASURED)]
    slowest = min(times, key=times.__getitem__)
    middle = 1.0 / _mean([1.0 / each for each in times.values()])
    seen = f"{middle:.2f}, least {times[slowest]:.2f} ({slowest})"
    return [verdict(what, seen, middle >= mean and times[slowest] >= least)]


def _quality(words: str, rows: Sequence[dict[str, Any]]) -> Verdict:
    worst = {name: max((row["chi2_ratio"].get(name, math.inf), row["dataset"]) for row in rows) for name in QUALITY}
    seen = ", ".join(f"{name} {ratio:.6f} ({dataset})" for name, (ratio, dataset) in worst.items())
    is_met = all(worst[name][0] <= bar for name, bar in QUALITY.items())
    return verdict(f"{words}: χ²/χ²_batch at most {QUALITY_WORDS}", seen, is_met)


def _mean(numbers: Sequence[float | None]) -> float:
    """Geometric; 0 of none."""
    known = [each for each in numbers if each]
    return math.exp(sum(map(math.log, known)) / len(known)) if known else 0.0
