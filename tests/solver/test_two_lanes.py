"""Where vectors have two numbers, as on aarch64: rows of squares are so close that what is copied too much reaches far.

Of the processors that run these tests vectors have more, so this is a process that takes its own for an older one,
without compilation.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

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


FORMULAS = """
import llvmlite.binding

features = llvmlite.binding.get_host_cpu_features()
features["avx"], features["avx512f"] = LANES == 4, False
llvmlite.binding.get_host_cpu_features = lambda: features

from factorbus.solver.formulas import terms
from solver import test_expressions

assert terms.LANES == LANES
test_expressions.SEEDS = 30
test_expressions.test_how_far_random_expressions_are_from_a_linear_model_is_what_numpy_computes()
print("as NumPy")
"""


@pytest.mark.parametrize("lanes", [2, 4])
def test_own_kinds_are_as_far_from_their_linear_models_as_numpy_says(lanes: int) -> None:
    assert run(f"LANES = {lanes}\n{FORMULAS}") == "as NumPy"


def test_covariances_are_those_of_the_dense_inverse() -> None:
    """Of points with a scale beside a frame in their separator: the last run of a row has one number there."""
    assert run(SCRIPT) == "as dense"


def run(script: str) -> str:
    """What it prints, of a process without compilation."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    return done.stdout.strip() or done.stderr
