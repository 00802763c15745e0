"""Compiling ahead: every kernel is found, and nothing is left to compile for a step."""

import subprocess
import sys

from factorbus.solver import warm
from factorbus.solver.kernels.jit import compile as _jit
from factorbus.solver.warm import _iter_groups


def test_progress_is_told_of_every_group_and_a_second_time_costs_nothing() -> None:
    seen: list[str] = []
    warm(seen.append)
    assert {"model.linearize", "graph.admit", "graph.initialize", "graph.block_pattern", "model.retract"} <= set(
        seen
    ) or _jit.DISABLED
    assert warm() == 0.0


def test_after_warming_a_drive_compiles_nothing_in_any_mode() -> None:
    # In a process of its own: with Numba as it is, what this one has compiled on the way is not on disk.
    subprocess.run([sys.executable, "-c", "from factorbus.solver import warm; warm()"], check=True, timeout=600)
    script = (
        "from factorbus.simulate import manhattan\n"
        "from factorbus.solver import Options, Solver, compile_seconds\n"
        "taken = set()\n"
        "for mode in ('inc-l', 'inc-l-b10', 'all-batch'):\n"
        "    solver = Solver(Options(mode=mode))\n"
        "    for step in manhattan(300, 1):\n"
        "        solver.stage(step.batch)\n"
        "        taken.add(solver.step().strategy)\n"
        "    solver.step(settle=True)\n"
        "    solver.estimate(), solver.changed(), solver.graph()\n"
        "assert taken >= {'extend', 'omega', 'full', 'all-batch'}, taken\n"
        "assert compile_seconds() == 0.0, compile_seconds()\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=110)


def test_every_file_with_kernels_is_a_group() -> None:
    groups = dict(_iter_groups())
    if not _jit.DISABLED:
        assert {
            "model.linearize",
            "graph.admit",
            "sparse.amd",
            "sparse.multifrontal",
            "bayes_tree.step",
        } <= groups.keys()
