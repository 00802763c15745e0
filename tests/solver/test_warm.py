"""Compiling ahead: every kernel is found, and nothing is left to compile for a step."""

import subprocess
import sys

from factorbus.solver import warm
from factorbus.solver.kernels import _jit
from factorbus.solver.warm import _iter_groups


def test_progress_is_told_of_every_group_and_a_second_time_costs_nothing() -> None:
    seen: list[str] = []
    assert warm(seen.append) >= 0.0
    assert {"linearise", "admit", "reach", "pattern", "move"} <= set(seen) or _jit.DISABLED
    assert warm() == 0.0


def test_after_warming_a_step_compiles_nothing() -> None:
    warm()
    script = (
        "import numpy as np\n"
        "from factorbus.proto.messages import Batch, Factors, Variables\n"
        "from factorbus.solver import Solver, compiled_seconds\n"
        "info = np.array([[1.0, 0, 0, 1, 0, 1]])\n"
        "solver = Solver()\n"
        "first, second = Variables('se2', np.array([0]), np.zeros((1, 3)), True), Variables('se2', np.array([1]))\n"
        "solver.stage(Batch((first, second), (\n"
        "    Factors('between_se2', np.array([[0, 1], [0, 1]]), np.array([[1.0, 0, 0], [2.0, 0, 0]]),\n"
        "            np.repeat(info, 2, 0)),)))\n"
        "assert solver.step(settle=True).strategy == 'all-batch'\n"
        "assert abs(solver.chi2() - 0.5) < 1e-12\n"
        "solver.estimate(), solver.changed(), solver.graph()\n"
        "assert compiled_seconds() == 0.0, compiled_seconds()\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=110)


def test_every_file_with_kernels_is_a_group() -> None:
    groups = dict(_iter_groups())
    if not _jit.DISABLED:
        assert {"linearise", "admit", "reach", "pattern", "move", "amd", "multifrontal"} <= groups.keys()
