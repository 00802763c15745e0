"""Drives with an IMU and GNSS, online, pose by pose: ours beside GTSAM's iSAM2 with the same factors.

    factorbus bench inertial [--only NAME,...] [--every N] [--json]

The data ship in the gtsam wheel.  Of each GNSS measurement there is a pose with a velocity and a bias, joined to those
before by the IMU's samples between; every tenth position of `kitti` is used, as GTSAM's example does, and every one of
`imu_gps`.

    kitti      KittiEquivBiasedImu and KittiGps_converted: 8 minutes in a car, 100 samples a second
    imu_gps    imuAndGPSdata: a simulated drive of 100 s, 200 samples a second

A row has dataset, solver, versions, steps, and
    cpu_s          CPU time of all steps: of ours with everything from the insert on, of iSAM2's update() alone
    preintegrate_s what GTSAM's preintegration takes beside that, called from Python for each sample
    step_ms        median; p99_ms
    error_m        root mean square distance of the final positions from GNSS, those included that no factor has
    newest_m       the same of the newest position at its step
    chi2_ratio     the most that χ² was over that of its batch optimum, at every N-th step; of an optimum below 1, by
                   how much it was more, plus 1.  chi2_median: the median.  worst_step: where the most was
It is held against: ours in at most a fifth of iSAM2's CPU time, an error_m no worse by more than 1 %, and χ² within
1.002 of its optimum.
"""

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from bench.drive_rows import DriveBench, print_rows
from bench.drives_with_imu import DRIVES, Drive, drive_of
from bench.inertial_solvers import SOLVERS

_FASTER, _WORSE, _CHI2 = 0.2, 1.01, 1.002
_WARM = 30  # steps driven beforehand, so that no library loads anything on the clock, as in `bench peers`


def main() -> int:
    """Drive and print; the exit code is 1 when a target is missed."""
    return print_rows(DriveBench("inertial", __doc__ or "", tuple(DRIVES), "χ²", 10, driven, missed))


def driven(name: str, steps: int | None, every: int) -> list[dict[str, Any]]:
    """The rows of a drive."""
    drive = drive_of(name, steps)
    return [measured(drive, solver, every) for solver in SOLVERS]


def measured(drive: Drive, name: str, every: int) -> dict[str, Any]:
    """The row of a drive with a solver: one drive to time, and one to look at χ²."""
    warm, timed, looked = (SOLVERS[name](drive) for _ in range(3))
    for n in range(min(_WARM, drive.steps)):
        warm.step(n)
    took, newest, ratios = [], [], {0: 1.0}
    for n in range(drive.steps):
        took.append(timed.step(n))
        newest.append(timed.position(n))
        looked.step(n)
        if n and (n % every == 0 or n == drive.steps - 1):
            chi2, best = looked.chi2_and_optimum()
            ratios[n] = 1.0 + (chi2 - best) / max(best, 1.0)
    worst = max(ratios, key=ratios.__getitem__)
    final = np.array([timed.position(n) for n in range(drive.steps)])
    return {
        "dataset": drive.name, "solver": name, "versions": timed.versions, "steps": drive.steps,
        "cpu_s": round(sum(took), 3), "preintegrate_s": round(timed.preintegrate_s, 3),
        "step_ms": round(1e3 * float(np.median(took)), 3), "p99_ms": round(1e3 * float(np.quantile(took, 0.99)), 3),
        "error_m": round(_rms(final - drive.positions), 4), "newest_m": round(_rms(newest - drive.positions), 4),
        "chi2_ratio": round(ratios[worst], 6), "chi2_median": round(float(np.median([*ratios.values()])), 6),
        "worst_step": worst,
    }  # fmt: skip


def _rms(off: np.ndarray) -> float:
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def missed(rows: list[dict[str, Any]]) -> list[str]:
    """What is not as wanted, in words."""
    found, by = [], {(row["dataset"], row["solver"]): row for row in rows}
    for (dataset, solver), ours in by.items():
        theirs = by.get((dataset, "isam2"))
        if solver != "factorbus" or theirs is None:
            continue
        if ours["cpu_s"] > _FASTER * theirs["cpu_s"]:
            found.append(f"{dataset}: {ours['cpu_s'] / theirs['cpu_s']:.2f} of iSAM2's CPU time; wanted {_FASTER}")
        if ours["error_m"] > _WORSE * theirs["error_m"]:
            found.append(f"{dataset}: {ours['error_m']} m from GNSS, iSAM2 {theirs['error_m']} m")
        if ours["chi2_ratio"] > _CHI2:
            found.append(f"{dataset}: χ² up to {ours['chi2_ratio']} of its optimum; wanted {_CHI2}")
    return found


if __name__ == "__main__":
    sys.exit(main())
