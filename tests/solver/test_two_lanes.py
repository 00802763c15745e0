"""Where vectors have two numbers, as on aarch64: rows of squares are so close that what is copied too much reaches far.

Of the processors that run these tests vectors have more, so this is a process that takes its own for an older one,
without compilation.
"""

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = """
import llvmlite.binding

features = llvmlite.binding.get_host_cpu_features()
features["avx"] = features["avx512f"] = False
llvmlite.binding.get_host_cpu_features = lambda: features

import numpy as np
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.kernels.jit.simd import LANES
from solver.test_derived_kinds import close, dense, keys_in, solved

assert LANES == 2
for mode in ("bayes-tree", "inc-l"):
    solver = solved("calibration", 0, mode)
    twin, diagonal = dense(solver), CovarianceBlocks(solver.covariances.factored()).diagonal()
    for v, key in enumerate(keys_in(solver)):
        wanted = twin.joint([key])
        close(diagonal[v, : len(wanted), : len(wanted)], wanted, 1e-7)
print("as dense")
"""


def test_covariances_are_those_of_the_dense_inverse() -> None:
    """Of points with a scale beside a frame in their separator: the last run of a row has one number there."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.stdout.strip() == "as dense", done.stderr
