"""A kind of factor that a client has written itself beside the solver's own, and a Python factor in GTSAM.

    factorbus bench own [--only NAME] [--poses N] [--repetitions N] [--no-gtsam] [--json]

A data set of poses in space is replayed pose by pose, all variables read after every step, in one process on one core;
CPU seconds, the replays of one repetition in turn, medians of repetitions:

    ours           `between_se3`
    ours, own      the same residual as a formula
    isam2          GTSAM's BetweenFactorPose3, `update()` and `calculateEstimate()`
    isam2, python  the same in Python, `CustomFactor`

Told are the seconds of each, the time of ours with own kinds over that without (bar: 1.2), that of GTSAM, χ² at the
end, and how long the first own factor takes from an insert to the estimate in a process that has had none (bar: 3 s).
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import gtsam
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.replays.gtsam_factors import gtsam_factors, held, pose3
from bench.replays.own_kinds import in_own_kinds, with_values
from bench.replays.problems import ALL, Problem, choose, load

from factorbus.proto.messages import Batch, Factors
from factorbus.service.process.worker_threads import core_count
from factorbus.solver import Options, Solver

_MOST_SHARE, _MOST_FIRST_S = 1.2, 3.0
_HALVES = np.array([1, 1, 1, 0.5, 0.5, 0.5])


def main() -> int:
    """Replay and tell; the exit code is 1 where a bar is missed."""
    parser = argparse.ArgumentParser(prog="factorbus bench own", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="sphere2500", help="a data set of poses in space")
    parser.add_argument("--poses", type=int, default=0, help="how many first poses; 0: all")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--no-gtsam", action="store_true")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    told = parser.parse_args()
    there = [each for each in choose(False, ALL)[0] if each.name == told.only]
    problem = there[0] if there else Problem("sphere", "a sphere (simulated)", poses=1000, seed=1)
    batches = with_values(load(problem.shortened(told.poses) if told.poses else problem))
    own = [in_own_kinds(batch) for batch in batches]
    first = first_own(own)
    runs: dict[str, Any] = {"ours": lambda: ours(batches), "ours, own": lambda: ours(own)}
    if not told.no_gtsam:
        runs |= {"isam2": lambda: isam2(batches, False), "isam2, python": lambda: isam2(batches, True)}
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    chi2: dict[str, float] = {}
    for _ in range(told.repetitions):
        for name, run in runs.items():
            spent, chi2[name] = run()
            seconds[name].append(spent)
    cpu = {name: median(all_of) for name, all_of in seconds.items()}
    result = {
        "dataset": problem.label,
        "steps": len(batches),
        "cores": core_count(),
        "first_own_s": round(first, 3),
        "own_over_built_in": round(cpu["ours, own"] / cpu["ours"], 3),
        **({} if told.no_gtsam else {"python_over_built_in_gtsam": round(cpu["isam2, python"] / cpu["isam2"], 3)}),
        "rows": [
            {"solver": name, "cpu_s": round(cpu[name], 3), "step_ms": round(1e3 * cpu[name] / len(batches), 4)}
            | {"chi2": round(chi2[name], 3)}
            for name in runs
        ],
    }
    print(json.dumps(result, indent=1) if told.json else _text(result))
    return 0 if result["own_over_built_in"] <= _MOST_SHARE and first <= _MOST_FIRST_S else 1


def first_own(batches: Sequence[Batch]) -> float:
    """Seconds by the clock of the first step in this process that has own kinds."""
    solver = Solver(Options())
    solver.stage(batches[0])
    solver.step()
    start = time.perf_counter()
    solver.stage(batches[1])
    solver.step()
    solver.estimate()
    return time.perf_counter() - start


def ours(batches: Sequence[Batch]) -> tuple[float, float]:
    """CPU seconds, and χ² in the end."""
    solver, spent = Solver(Options()), 0.0
    for batch in batches:
        start = time.process_time()
        solver.stage(batch)
        solver.step()
        solver.estimate()
        spent += time.process_time() - start
    return spent, solver.chi2()


def isam2(batches: Sequence[Batch], in_python: bool) -> tuple[float, float]:
    """CPU seconds of update and estimate, and χ² in the end."""
    isam, spent = gtsam.ISAM2(_parameters()), 0.0
    for batch in batches:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for group in batch.variables:
            for key, row in zip(group.keys.tolist(), group.values if group.values is not None else (), strict=True):
                values.insert(key, pose3(row))
                if group.fixed:
                    graph.add(held(group.kind, key, values))
        for group in batch.factors:
            for factor in _custom(group) if in_python and group.kind == "between_se3" else gtsam_factors(group):
                graph.add(factor)
        start = time.process_time()
        isam.update(graph, values)
        estimate = isam.calculateEstimate()
        spent += time.process_time() - start
    return spent, 2 * isam.getFactorsUnsafe().error(estimate)


def _parameters() -> Any:
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.1)
    parameters.relinearizeSkip = 1
    return parameters


def _custom(group: Factors) -> Any:
    """Relative poses as Python functions, as GTSAM's documentation writes them."""
    upper = np.triu_indices(6)
    for (i, j), z, triangle in zip(group.keys.tolist(), group.measured, group.information, strict=True):
        full = np.zeros((6, 6))
        full[upper] = full.T[upper] = triangle
        full = (full * np.outer(_HALVES, _HALVES))[np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])]
        noise = gtsam.noiseModel.Gaussian.Information(full)
        yield gtsam.CustomFactor(noise, [i, j], _between(pose3(z)))


def _between(measured: Any) -> Any:
    def error(this: Any, values: Any, jacobians: Any) -> Any:
        a, b = (values.atPose3(key) for key in list(this.keys()))
        if jacobians is None:
            return measured.localCoordinates(a.between(b))
        A, B = (np.zeros((6, 6), order="F") for _ in range(2))
        E = np.zeros((6, 6), order="F")
        relative = a.between(b, A, B)
        r = measured.localCoordinates(relative, np.zeros((6, 6), order="F"), E)
        jacobians[0], jacobians[1] = E @ A, E @ B
        return r

    return error


def _text(result: dict[str, Any]) -> str:
    lines = [f"{result['dataset']}, {result['steps']} steps; the first own factor after {result['first_own_s']} s"]
    lines += [
        f"{row['solver']:15} {row['cpu_s']:9.3f} CPU s  {row['step_ms']:8.4f} ms a step  χ² {row['chi2']}"
        for row in result["rows"]
    ]
    lines += [f"own over built-in: {result['own_over_built_in']}"]
    if "python_over_built_in_gtsam" in result:
        lines += [f"Python over built-in in GTSAM: {result['python_over_built_in_gtsam']}"]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
