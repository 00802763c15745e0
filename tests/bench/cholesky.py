"""Our block Cholesky against CHOLMOD (scikit-sparse): the same matrix, the same order, known pattern, one core.

    python tests/bench/cholesky.py [--json] [--repetitions N] [NAME ...]

NAME: generated problems (grid2d, grid3d) and data sets (city10000, sphere2500, ...; `factorbus datasets` says which
are here); by default the two generated ones and, where they are here, city10000, sphere2500, manhattan3500 and
victoria_park.

Both sides get the matrix in final elimination order, so CHOLMOD has nothing to permute, and only the lower triangle,
all that it reads.  Thread CPU time, repetitions interleaved, ratios taken within a repetition, medians.  CHOLMOD is as
fast as its BLAS, so the report names it: the reference BLAS (Debian's libblas3) makes it up to four times slower, and a
comparison with that is not an honest one.

The two solutions x of the same random right-hand side η are to agree to 1e-10 of their largest entry, or to the digits
that any solver has: the 2e-16 of rounding times ‖Λ‖ ‖x‖ / ‖η‖, which is no more than Λ's condition.  Of victoria_park,
whose weights go from 1.6 to 250,000 along 7,000 poses, these are seven.
"""

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # read when the library is loaded

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from bench.replays.full_pass import cholmod_blas, system_of
from bench.replays.problems import file_of
from naive.block_systems import BlockSystem, grid
from scipy.sparse import csc_matrix, tril

from factorbus.datasets import find
from factorbus.formats import read
from factorbus.solver import Options, Solver
from factorbus.solver.errors import NoBackend
from factorbus.solver.kernels.jit.simd import LANES
from factorbus.solver.sparse.cholesky import Cholesky
from factorbus.solver.sparse.cholmod import require_cholmod
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import Symbolic, analyze

GENERATED = {"grid2d": lambda: grid(80, 3), "grid3d": lambda: grid(50, 6)}
DATASETS = ("city10000", "sphere2500", "manhattan3500", "victoria_park")
MODES = ("simplicial", "supernodal")


def main() -> None:
    """Measure and print; exit 1 when the answers differ or CHOLMOD is faster."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    parser.add_argument("--repetitions", type=int, default=15)
    options = parser.parse_args()
    try:
        require_cholmod()
    except NoBackend as problem:
        sys.exit(f"bench cholesky: {problem}")
    core = pin()
    names = options.names or [*GENERATED, *(name for name in DATASETS if find(name))]
    report: dict[str, Any] = {"cholmod_blas": cholmod_blas(), "core": core, "lanes": LANES, "problems": []}
    if not options.json:
        print(f"CHOLMOD uses {', '.join(report['cholmod_blas'])}; one thread on core {core}; {LANES} lanes")
        print(HEAD)
    for name in names:
        system = GENERATED[name]() if name in GENERATED else final_system(file_of(name))
        row = {"name": name, **measure(system, options.repetitions)}
        report["problems"].append(row)
        if not options.json:
            print(line(row), flush=True)
    if options.json:
        print(json.dumps(report, indent=2))
    if apart := [row["name"] for row in report["problems"] if not agree(row)]:
        sys.exit(f"the two solutions differ on {', '.join(apart)}")
    slower = [row["name"] for row in report["problems"] if row["ratio"] < 1.0]
    if slower:
        sys.exit(f"CHOLMOD is faster on {', '.join(slower)}")


def final_system(path: Path) -> BlockSystem:
    """Λ of the whole file, linearized where the solver ends from the file's own start."""
    solver = Solver(Options(mode="all-batch"))
    solver.stage(read(path).whole())
    solver.step(settle=True)
    return system_of(solver)


def measure(system: BlockSystem, repetitions: int) -> dict[str, Any]:
    """Milliseconds of both sides, and how far their solutions are apart (relative to the largest entry)."""
    perm = order(system.dims, system.rows, system.cols)
    symbolic, cholesky = analyze(system.dims, system.rows, system.cols, perm), Cholesky()
    lower, in_order = cholmod_matrix(system, symbolic), symbolic.scalar_order()
    eta = np.random.default_rng(1).normal(size=symbolic.size)
    peers = {mode: require_cholmod().analyze(lower, mode=mode, ordering_method="natural") for mode in MODES}
    jobs: dict[str, Callable[[], Any]] = {
        "order": lambda: order(system.dims, system.rows, system.cols),
        "analyze": lambda: analyze(system.dims, system.rows, system.cols, perm),
        "factorize": lambda: cholesky.factorize(symbolic, system.data, system.offsets),
        "solve": lambda: cholesky.solve(eta),
    }
    for mode, peer in peers.items():
        jobs[f"cholmod_{mode}"] = lambda peer=peer: peer.cholesky_inplace(lower)
        jobs[f"cholmod_{mode}_solve"] = lambda peer=peer: peer(eta)
    times = interleaved(jobs, repetitions)
    best = min(MODES, key=lambda mode: statistics.median(times[f"cholmod_{mode}"]))
    ours, theirs, expected = times["factorize"], times[f"cholmod_{best}"], peers[best](eta[in_order])
    return {
        "variables": len(system.dims),
        "scalars": symbolic.size,
        "nnz_r": symbolic.nnz_r,
        "nnz_r_cholmod_amd": cholmod_nonzeros(system),
        "megaflops": symbolic.flops / 1e6,
        "gigaflops_per_s": symbolic.flops / statistics.median(ours) / 1e9,
        **{f"{name}_ms": statistics.median(values) * 1e3 for name, values in times.items()},
        "cholmod_best": best,
        "ratio": statistics.median(b / a for a, b in zip(ours, theirs, strict=True)),
        "difference": float(np.abs(cholesky.solve(eta)[in_order] - expected).max() / np.abs(expected).max()),
        "condition": norm(lower) * float(np.abs(expected).max() / np.abs(eta).max()),
    }


def agree(row: dict[str, Any]) -> bool:
    """Whether the two have the same digits."""
    return row["difference"] < max(1e-10, np.finfo(float).eps * row["condition"])


def norm(lower: csc_matrix) -> float:
    """The largest sum of a row of |Λ|."""
    sizes = abs(lower)
    ones = np.ones(sizes.shape[0])
    return float((sizes @ ones + sizes.T @ ones - sizes.diagonal()).max())


def interleaved(jobs: dict[str, Callable[[], Any]], repetitions: int) -> dict[str, list[float]]:
    """Thread CPU seconds of each job, one of each after another; the first round warms up and is not counted."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for repetition in range(repetitions + 1):
        for name, job in jobs.items():
            start = time.thread_time()
            job()
            if repetition:
                times[name].append(time.thread_time() - start)
    return times


def cholmod_matrix(system: BlockSystem, symbolic: Symbolic) -> csc_matrix:
    """The lower triangle of Λ in elimination order."""
    in_order = symbolic.scalar_order()
    matrix = csc_matrix(tril(system.sparse()[in_order][:, in_order]))
    matrix.sort_indices()
    return matrix


def cholmod_nonzeros(system: BlockSystem) -> int:
    """Nonzeros of CHOLMOD's own factor when it orders Λ itself, by AMD."""
    matrix = csc_matrix(system.sparse())
    factor = require_cholmod().analyze(matrix, mode="simplicial", ordering_method="amd")
    factor.cholesky_inplace(matrix)
    return int(factor.L().nnz)


def pin() -> int:
    """Stay on the last core this process may use."""
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return core


HEAD = (
    f"{'':16}{'scalars':>8}{'nnz(R)':>9}{'/ AMD':>7}{'order':>8}{'analyze':>8}{'factor':>8}{'GF/s':>6}{'solve':>7}"
    f"{'simplicial':>12}{'supernodal':>12}{'ratio':>7}{'difference':>12}{'condition':>11}"
)


def line(row: dict[str, Any]) -> str:
    """One row of the table; milliseconds."""
    return (
        f"{row['name']:16}{row['scalars']:8}{row['nnz_r']:9}{row['nnz_r'] / row['nnz_r_cholmod_amd']:7.3f}"
        f"{row['order_ms']:8.2f}{row['analyze_ms']:8.2f}{row['factorize_ms']:8.2f}{row['gigaflops_per_s']:6.1f}"
        f"{row['solve_ms']:7.2f}{row['cholmod_simplicial_ms']:12.2f}{row['cholmod_supernodal_ms']:12.2f}"
        f"{row['ratio']:7.2f}{row['difference']:12.1e}{row['condition']:11.1e}"
    )


if __name__ == "__main__":
    main()
