"""What sensors hide is found out: how far off it ends, in units of what the map says of it.

    factorbus bench calibration [--seeds N] [--json]

Of each seed a drive is made anew, seeds are printed.  What is hidden is drawn around what the robot believes, which is
its prior: of a mount 5 degrees and 0.1 m standard deviation, of the others as `calibrated_drives` says.  The first
pose of the map is fixed.

    plane    a mount: a scanner sees posts, `landmark_se2_mount`
    space    the same in space, `landmark_se3_mount`
    camera   a camera sees corners, `point_seen_mount`
    way      a sensor measures its own way beside the robot's odometry, `between_se3_mount`
    scale, frame, offset, bias   see `calibrated_drives`

d² = eᵀ Σ⁻¹ e, e the error of what was hidden in its tangent space and Σ its covariance as the map has it.  It is found
where d² is below the 99.73 % quantile of χ²: within three standard deviations, were it one number.  Of right
covariances the mean of d² is the number of scalars (NEES); its range is that of 99.73 % of such means.  `each` is the
same scalar by scalar: the share of |eᵢ| ≤ 3 σᵢ, 99.73 % of right ones, over all scalars and seeds, and of the
scalar that is found least often.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.calibrated_drives import DRIVES, way_of
from naive.dense_derived import base_ends
from naive.dense_factors import boxminus, boxplus, pose_matrix, pose_vector

from factorbus.client import Camera, Draft
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver
from factorbus.solver.covariance.blocks import CovarianceBlocks

MOUNTS = ("plane", "space", "camera", "way")
WORLDS = (*MOUNTS, *DRIVES)
BELIEVED = {"se2": np.zeros(3), "se3": np.array([0, 0, 0, 0, 0, 0, 1.0])}
PRIOR = {"se2": [0.1, 0.1, np.radians(5)], "se3": [0.1] * 3 + [np.radians(5)] * 3}
ODOMETRY = {"se2": [0.02, 0.02, 0.01], "se3": [0.02] * 3 + [0.01] * 3}
CAMERA = Camera("pinhole", (400.0, 400.0, 320.0, 240.0), width=640, height=480)
POSES, SEEN = 60, 5
_SURE = 0.9973


def main() -> int:
    """Drive and tell; the exit code is 1 where fewer than 99 % are found, or a mean of d² is out of its range."""
    parser = argparse.ArgumentParser(prog="factorbus bench calibration", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=100, help="drives of each world")
    parser.add_argument("--seed", type=int, help="the first seed; without, another one each time")
    parser.add_argument("--only", default=",".join(WORLDS), help="WORLD,...")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    told = parser.parse_args()
    first = int(np.random.default_rng().integers(2**31)) if told.seed is None else told.seed
    rows: list[dict[str, Any]] = []
    for world in told.only.split(","):
        each = [drive(world, first + n) for n in range(told.seeds)]
        rows.append(summary(world, first, np.array([d2 for d2, _ in each]), np.array([off for _, off in each])))
        if not told.json:
            print("  ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    if told.json:
        print(json.dumps({"rows": rows}))
    return 0 if all(row["found"] >= 0.99 and row["least"] <= row["nees"] <= row["most"] for row in rows) else 1


def summary(world: str, first: int, d2: np.ndarray, sigmas: np.ndarray) -> dict[str, Any]:
    """Share that is found, and the mean of d² with the range that it has if covariances are right.

    d2 (seeds,).  sigmas (seeds, scalars): how far each scalar is off, in its standard deviations.
    """
    dim, within = sigmas.shape[1], (np.abs(sigmas) <= 3.0).mean(axis=0)
    found = float(np.mean(d2 <= chdtri(dim, 1 - _SURE)))
    freedom = dim * d2.size
    least, most = (float(chdtri(freedom, 0.5 + sign * _SURE / 2)) / d2.size for sign in (1, -1))
    return {
        "world": world, "seeds": f"{first}..{first + d2.size - 1}", "scalars": dim, "found": found,
        "each": round(float(within.mean()), 4), "each_least": round(float(within.min()), 4),
        "nees": round(float(d2.mean()), 3), "least": round(least, 3), "most": round(most, 3),
    }  # fmt: skip


def drive(world: str, seed: int) -> tuple[float, np.ndarray]:
    """(d², eᵢ / σᵢ) of what was hidden, after a drive."""
    return drive_with_mount(world, seed) if world in MOUNTS else calibrated_drive(world, seed)


def calibrated_drive(world: str, seed: int) -> tuple[float, np.ndarray]:
    """The same of a drive of `calibrated_drives`."""
    rng = np.random.default_rng(seed)
    hidden = DRIVES[world](rng)
    kind = "se3" if hidden.kind == "se3" else "se2"
    solver, pose, way = Solver(Options()), BELIEVED[kind], BELIEVED[kind]
    for n in range(POSES):
        if n:
            way = way_of(kind, n, hidden.speed)
            pose = pose_vector(pose_matrix(pose) @ pose_matrix(way))
        draft = hidden.step(n, pose, way)
        solver.stage(draft.variable(kind, f"x{n}", pose if n == 0 else None, fixed=n == 0).batch())
        solver.step()
    solver.step(settle=True)
    return off(solver, symbol("c", 0), hidden.kind, hidden.truth)


def drive_with_mount(world: str, seed: int) -> tuple[float, np.ndarray]:
    """The same of the mount after a drive."""
    rng, space = np.random.default_rng(seed), "se2" if world == "plane" else "se3"
    believed, odometry = BELIEVED[space], np.array(ODOMETRY[space])
    mount = boxplus(space, believed, rng.normal(0, PRIOR[space]))
    if world == "camera":  # it looks ahead: its z axis is the robot's x axis
        ahead = np.array([0, 0, 0, -0.5, 0.5, -0.5, 0.5])
        believed = ahead
        mount = boxplus(space, ahead, rng.normal(0, PRIOR[space]))
    points = rng.uniform(-8, 8, (40, 2 if space == "se2" else 3)) + (0 if world != "camera" else np.array([12, 0, 0]))
    solver, pose, known = Solver(Options()), BELIEVED[space], set[int]()
    for n in range(POSES):
        draft, way = Draft(), way_of(space, n, 0.6)
        if n == 0:
            draft.variable(space, "x0", pose, fixed=True).variable(space, "m0", believed)
            draft.factor(f"prior_{space}", ["m0"], believed, sigmas=PRIOR[space])
        else:
            before, pose = pose, pose_vector(pose_matrix(pose) @ pose_matrix(way))
            draft.variable(space, f"x{n}")
            measured = boxplus(space, way, rng.normal(0, odometry))
            draft.factor(f"between_{space}", [f"x{n - 1}", f"x{n}"], measured, sigmas=odometry)
            if world == "way":
                (a, b), _ = base_ends(f"between_{space}_mount", [before, pose, mount], np.zeros(0))
                own = pose_vector(np.linalg.inv(pose_matrix(a)) @ pose_matrix(b))
                own = boxplus(space, own, rng.normal(0, odometry))
                draft.factor(f"between_{space}_mount", [f"x{n - 1}", f"x{n}", "m0"], own, sigmas=odometry)
        if world != "way":
            see(draft, world, n, (pose, mount, points), known, rng)
        solver.stage(draft.batch())
        solver.step()
    solver.step(settle=True)
    return off(solver, symbol("m", 0), space, mount)


def see(
    draft: Draft,
    world: str,
    n: int,
    truth: tuple[np.ndarray, np.ndarray, np.ndarray],
    known: set[int],
    rng: np.random.Generator,
) -> None:
    """A few points as the sensor sees them; a new one comes with a rough place and what is known of it."""
    pose, mount, points = truth
    dim = points.shape[1]
    sensor = np.linalg.inv(pose_matrix(pose) @ pose_matrix(mount))
    for k in rng.permutation(len(points))[: 3 * SEEN].tolist():
        seen = (sensor @ np.append(points[k], 1.0))[:dim]
        if world == "camera":
            pixel = 400 * seen[:2] / max(seen[2], 0.1) + (320, 240) + rng.normal(0, 1, 2)
            if seen[2] < 1 or not (0 < pixel[0] < 640 and 0 < pixel[1] < 480):
                continue
        if k not in known:
            known.add(k)
            rough = points[k] + rng.normal(0, 0.3, dim)
            draft.variable(f"point{dim}", f"l{k}", rough)
            draft.factor(f"prior_point{dim}", [f"l{k}"], rough, sigmas=[0.3] * dim)
        if world == "camera":
            draft.point_seen(f"x{n}", f"l{k}", CAMERA, pixel, mount="m0", sigmas=(1, 1))
        else:
            z = seen + rng.normal(0, 0.05, dim)
            draft.factor(f"landmark_se{dim}_mount", [f"x{n}", f"l{k}", "m0"], z, sigmas=[0.05] * dim)


def off(solver: Solver, key: int, kind: str, truth: np.ndarray) -> tuple[float, np.ndarray]:
    """(d², eᵢ / σᵢ) of a variable."""
    factored = solver.covariances.factored()
    variable = factored.graph.find(key)
    sigma = CovarianceBlocks(factored).joint(np.array([variable]))
    (group,) = factored.graph.variables(np.array([variable]))
    error = boxminus(kind, truth, group.values[0])
    return float(error @ np.linalg.solve(sigma, error)), error / np.sqrt(sigma.diagonal())


if __name__ == "__main__":
    sys.exit(main())
