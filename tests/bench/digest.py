"""What every step did and what it came to, as digests: equal before and after a change that is to change no result.

    factorbus bench digest --out before                      on the commit before
    factorbus bench digest --out after --against before      on the commit after: exit code 1 where anything differs

Replayed are the public data sets that are there, simulated worlds in every mode, and inverse-depth covariance blocks.
Of each there are two digests: of the account of all steps (strategy, iterations, eliminated and relinearized variables,
flops, nonzeros of R, changed variables, converged), and of the bits of all estimates after every step.  Where bits
differ the largest difference of the last estimate is told, as a share of the largest value.
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.replays.problems import ALL, Problem, choose, load
from naive.random_cameras import CAMERAS, random_observations

from factorbus import idp
from factorbus.idp import classical, independent, minimal
from factorbus.solver import Options, Solver
from factorbus.solver.modes import MODES

_WORLDS = (
    Problem("manhattan", "streets", poses=1200, seed=1),
    Problem("city_trees", "streets with trees", poses=1200, seed=2),
    Problem("sphere", "a sphere", poses=600, seed=3),
)
_SHORT = 250  # poses of a world in a mode that is not the default one
_ACCOUNT = (
    "strategy",
    "iterations",
    "eliminated",
    "relinearized",
    "flops",
    "nnz_r",
    "changed",
    "converged",
)
_CLOSE = 1e-9
_OBSERVATIONS = ((1, 0), (3, 0), (7, 1), (2, 30), (5, 120))  # new and present features

Row = dict[str, Any]


def main() -> int:
    """Parse, replay, compare; the exit code."""
    parser = argparse.ArgumentParser(prog="factorbus bench digest", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for digest.json and the last estimates")
    parser.add_argument("--against", type=Path, help="folder of a run on another commit, to compare with")
    parser.add_argument("--only", default="", help="NAME,...: these data sets and worlds")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    told = parser.parse_args()
    told.out.mkdir(parents=True, exist_ok=True)
    rows: dict[str, Row] = {}
    for name, run in _jobs([each for each in told.only.split(",") if each]):
        row, last = run()
        rows[name] = row
        np.save(told.out / f"{name}.npy", last)
        if not told.json:
            print(f"{name:40} {row['steps']:6} steps  account {row['account']}  bits {row['bits']}", flush=True)
    (told.out / "digest.json").write_text(json.dumps(rows, indent=1))
    if told.json:
        print(json.dumps(rows, indent=1))
    return 0 if told.against is None else _compare(rows, told.out, told.against)


def _jobs(only: list[str]) -> Iterator[tuple[str, Callable[[], tuple[Row, np.ndarray]]]]:
    sets = [each for each in choose(False, ALL)[0] if not each.is_world]
    runs = [(each.name, each, "auto") for each in sets]
    for world in _WORLDS:
        runs.append((world.name, world, "auto"))
        short = Problem(world.name, world.title, _SHORT, None, world.seed)
        runs += [(f"{world.name}-{mode}", short, mode) for mode in MODES if mode not in ("auto", "bayes-tree")]
    for name, problem, mode in runs:
        if not only or problem.name in only:
            yield name, lambda problem=problem, mode=mode: _replay(problem, mode)
    if not only or "idp" in only:
        yield "idp", _covariances


def _replay(problem: Problem, mode: str) -> tuple[Row, np.ndarray]:
    """A problem pose by pose: the digests, and the last estimate."""
    solver, steps = Solver(Options(mode=mode)), load(problem)
    account, bits = hashlib.blake2b(digest_size=8), hashlib.blake2b(digest_size=8)
    values = np.empty(0)
    for batch in steps:
        solver.stage(batch)
        report = solver.step()
        account.update(repr([getattr(report, name) for name in _ACCOUNT]).encode())
        values = np.concatenate([group.values.ravel() for group in solver.estimate()])
        bits.update(values.tobytes())
    return {"steps": len(steps), "account": account.hexdigest(), "bits": bits.hexdigest()}, values


def _covariances() -> tuple[Row, np.ndarray]:
    """Covariance blocks of new features, each way of computing them and every camera."""
    account, bits, found = hashlib.blake2b(digest_size=8), hashlib.blake2b(digest_size=8), []
    for camera in CAMERAS:
        for n, existing in _OBSERVATIONS:
            observations, P = random_observations(n, n, existing, camera)
            seen, padd = idp.see(observations), idp.padd(observations)
            A, B = idp.jacobians(observations, seen)
            for counted in (
                classical.covariance(P, A, B, padd),
                independent.covariance(P, A, B, padd),
                minimal.covariance(P, observations, seen),
            ):
                account.update(repr(counted.multiplications).encode())
                bits.update(counted.P.tobytes())
                found.append(counted.P.ravel())
    row = {"steps": len(found), "account": account.hexdigest(), "bits": bits.hexdigest()}
    return row, np.concatenate(found)


def _compare(rows: dict[str, Row], ours: Path, theirs: Path) -> int:
    """Say what differs from the other run; 1 where it does by more than the bits of last estimates within 1e-9."""
    other: dict[str, Row] = json.loads((theirs / "digest.json").read_text())
    failed = False
    for name in sorted(rows.keys() & other.keys()):
        if rows[name]["account"] != other[name]["account"]:
            failed = True
            print(f"{name}: the account of its steps differs", file=sys.stderr)
        if rows[name]["bits"] != other[name]["bits"]:
            mine, its = np.load(ours / f"{name}.npy"), np.load(theirs / f"{name}.npy")
            off = abs(mine - its).max() / max(abs(its).max(), 1.0) if mine.shape == its.shape else np.inf
            failed |= not off <= _CLOSE
            print(f"{name}: bits differ; the last estimate by {off:.1e} of its largest value", file=sys.stderr)
    missing = sorted(rows.keys() ^ other.keys())
    if missing:
        print(f"only in one of the two runs: {', '.join(missing)}", file=sys.stderr)
    if not failed:
        print(f"{len(rows.keys() & other.keys())} replays: the same account of every step", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
