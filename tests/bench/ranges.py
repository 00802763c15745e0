"""Range-only drives, online, pose by pose: ours beside GTSAM's iSAM2 with the same factors.

    factorbus bench ranges [--only NAME,...] [--every N] [--steps N] [--json]

The data ship in the gtsam wheel: goats_15, goats_16 (an underwater robot), plaza1, plaza2 (a lawn mower).  Nobody is
told where a beacon is: its ranges wait until they leave one place alone (`range_drives`); where that is at a step is
found from the estimate of ours, and both solvers get it.

A row has dataset, solver, versions, steps, and
    cpu_s        CPU time of all steps: of ours with all estimates read, of iSAM2's update() alone
    step_ms      median; p99_ms
    error_m      root mean square distance of the final positions from GPS, moved as one rigid body to where they fit
                 best; null for goats, which has dead reckoning alone
    beacon_m     the same of the beacons from where they were surveyed, moved as one rigid body on their own
    chi2_ratio   the most that χ² was over that of its batch optimum; of ours at every step that says converged
                 (judged: how many; unconverged: how many said false), of iSAM2 at every N-th step
    optimum_off  of ours: how far the final χ² is from the lowest of GTSAM's Levenberg-Marquardt, as a share of it,
                 both with the same residuals; of `optima`, from where each began: `file`, the file's own places,
                 `online`, where each variable came in, and `here`, where ours ended
    entered      of ours: [step, ranges, χ² of the next best place over that of the best] of each beacon
    waiting      of ours: beacons that never entered, with their ranges
It is held against: χ² within 1.002 of its optimum, an optimum as GTSAM's to 1e-6, and less CPU time than iSAM2.
"""

import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from bench.drive_rows import DriveBench, print_rows
from bench.range_drives import NAMES, Feed, feed_of, true_places, valued
from bench.range_solvers import Isam2, Ours, gtsam_optimum
from bench.replays.columns import F64

from factorbus.proto.messages import Batch, Variables

_CHI2, _OFF = 1.002, 1e-6


def main() -> int:
    """Drive and print; the exit code is 1 when a target is missed."""
    return print_rows(DriveBench("ranges", __doc__ or "", NAMES, "the χ² of iSAM2", 100, driven, missed))


def driven(name: str, steps: int | None, every: int) -> list[dict[str, Any]]:
    """The rows of a drive, the solvers taking turns step by step."""
    with tempfile.TemporaryDirectory() as folder:
        feed = feed_of(name, Path(folder), steps)
    ours, theirs = Ours(), Isam2()
    took: dict[str, list[float]] = {"factorbus": [], "isam2": []}
    ratio, judged, their_ratio = 1.0, 0, 1.0
    places: dict[int, F64] = {}
    first: dict[int, F64] = {}
    count = len(feed.poses)
    for n in range(count):
        batch = feed.step(n, places)
        took["factorbus"].append(ours.step(batch))
        took["isam2"].append(theirs.step(batch))
        places = ours.places() if feed.unplaced or n == count - 1 else places
        first |= {key: places[key] for key in places.keys() - first.keys()}
        if ours.converged:
            judged, ratio = judged + 1, max(ratio, ours.ratio())
        if n and (n % every == 0 or n == count - 1):
            their_ratio = max(their_ratio, theirs.ratio())
    both = {"chi2_ratio": round(their_ratio, 6)}
    rows = [_row(name, "isam2", theirs, took["isam2"], feed) | both]
    chi2, graph = ours.settle()
    starts = {"file": _by_key(feed.file.variables), "online": first, "here": _by_key(graph.variables)}
    optima = {start: gtsam_optimum(graph, _begun(graph, values)) for start, values in starts.items()}
    best = min(optima.values())
    own = {
        "chi2_ratio": round(ratio, 6), "judged": judged, "unconverged": count - judged, "chi2": round(chi2, 6),
        "optima": {start: round(chi2, 6) for start, chi2 in optima.items()},
        "optimum_off": float(f"{(chi2 - best) / best:.2g}"),
        "entered": [[each.step, each.ranges, round(min(each.clear, 1e9), 1)] for each in feed.entered],
        "waiting": [len(waits.z) for waits in feed.waiting.values()],
    }  # fmt: skip
    return [_row(name, "factorbus", ours, took["factorbus"], feed) | own, *rows]


def missed(rows: list[dict[str, Any]]) -> list[str]:
    """What is not as wanted, in words."""
    found, by = [], {(row["dataset"], row["solver"]): row for row in rows}
    for (dataset, solver), ours in by.items():
        theirs = by.get((dataset, "isam2"))
        if solver != "factorbus" or theirs is None:
            continue
        if ours["chi2_ratio"] > _CHI2:
            found.append(f"{dataset}: χ² up to {ours['chi2_ratio']} of its optimum; wanted {_CHI2}")
        if not abs(ours["optimum_off"]) <= _OFF:
            found.append(f"{dataset}: the final χ² is {ours['optimum_off']} off that of GTSAM; wanted {_OFF}")
        if ours["cpu_s"] > theirs["cpu_s"]:
            found.append(f"{dataset}: {ours['cpu_s']} s, iSAM2 {theirs['cpu_s']} s")
    return found


def _row(name: str, solver: str, by: Any, took: list[float], feed: Feed) -> dict[str, Any]:
    places, truth = by.places(), true_places(name)
    at = np.array([places[key][:2] for key in feed.poses.tolist()])
    (surveyed,) = (group for group in feed.file.variables if group.kind == "point2")
    is_in = [row for row, key in enumerate(surveyed.keys.tolist()) if key in places]
    beacons = np.array([places[int(surveyed.keys[row])] for row in is_in]).reshape(-1, 2)
    return {
        "dataset": name, "solver": solver, "versions": by.versions, "steps": len(took),
        "cpu_s": round(sum(took), 3), "step_ms": round(1e3 * float(np.median(took)), 3),
        "p99_ms": round(1e3 * float(np.quantile(took, 0.99)), 3),
        "error_m": None if truth is None else _off(at, truth[: len(at)]),
        "beacon_m": _off(beacons, valued(surveyed)[is_in]) if len(is_in) > 2 else None,
    }  # fmt: skip


def _off(at: F64, truth: F64) -> float:
    """Root mean square distance of places (n, 2) from others, after the rigid motion that fits best."""
    here, there = at - at.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(here.T @ there)
    R = U @ np.diag([1.0, np.linalg.det(U @ Vt)]) @ Vt
    return round(float(np.sqrt(((here @ R - there) ** 2).sum(axis=1).mean())), 4)


def _begun(graph: Batch, start: Mapping[int, F64]) -> list[Variables]:
    """The variables of a graph at other places, but those that are fixed, which stay."""
    return [
        group if group.fixed else group._replace(values=np.array([start[key] for key in group.keys.tolist()]))
        for group in graph.variables
    ]


def _by_key(groups: Iterable[Variables]) -> dict[int, F64]:
    return {key: row for group in groups for key, row in zip(group.keys.tolist(), valued(group), strict=True)}


if __name__ == "__main__":
    sys.exit(main())
