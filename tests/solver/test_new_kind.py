"""A new kind of factor is its declarations: CONTRIBUTING.md, followed in a copy of the sources.

The copies run as plain Python, so nothing is compiled.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from factorbus.proto.kinds import FACTOR_KINDS, FactorKind
from factorbus.solver.kernels.model import kinds, layout, losses
from factorbus.solver.kernels.model.dispatch import check_same

ROOT = Path(__file__).parents[2]
ROOTS = ("proto", "service", "clients", "workers")
# Behind what a part of a file is written that CONTRIBUTING.md names.
BEHIND = {
    "FACTOR_KINDS": "FACTOR_KINDS = FactorKinds(\n    (kind.name, kind)\n    for kind in (\n",
    "FACTOR_MODELS": "FACTOR_MODELS = {\n",
    "the imports": "from factorbus.solver.kernels.model.camera import observation\n",
    "residual": 'Raises KeyError: it has no twin yet."""\n',
}
USED = """
import sys

import numpy as np
from naive.dense_factors import jacobians, residual
from naive.random_graphs import random_value
from naive.solver_parts import graph_in

from factorbus.client import Draft
from factorbus.client.merging import AbsoluteFactors, fit_into
from factorbus.proto import codec
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Estimate, MapGraph, Insert, Variables
from factorbus.solver import Options, Solver
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.why import why_factor

assert len(FACTOR_KINDS) == int(sys.argv[1]) + 1
pose = random_value("se3", np.random.default_rng(1))
draft = Draft().se3("x1", pose).prior_se3("x1", pose, sigmas=(1, 1, 1, 0.1, 0.1, 0.1))
draft = draft.factor("depth_se3", ("x1",), [pose[2] + 1.0], sigmas=0.1)
batch = codec.decode_insert(codec.encode_insert(Insert(1, draft.batch()))).batch
solver = Solver(Options())
solver.stage(batch)
solver.step(settle=True)
(group,) = solver.estimate()
# Two measurements of one number: their mean by weight.
assert abs(group.values[0, 2] - (pose[2] + 100.0 / 101.0)) < 1e-9
blocks = CovarianceBlocks(solver.covariances.factored())
covariance = blocks.joint(np.array([0]))
end = group.values[0]
(J,) = jacobians("depth_se3", ["se3"], [end], np.array([pose[2] + 1.0]))
assert abs(J[0] @ covariance @ J[0] - 1.0 / 101.0) < 1e-6
row = int(graph_in(solver).ids_of(np.array([1]))[0])
explained = why_factor(blocks, row)
assert explained.kind == "depth_se3"
(r,) = residual("depth_se3", [end], np.array([pose[2] + 1.0]))
assert abs(explained.residual[0] - r) < 1e-9
here = Estimate(7, 1, (Variables("se3", np.array([1]), pose[None]),))
try:
    fit_into(here, MapGraph(9, 1, batch), frame=(0, 0, 0, 0, 0, 0, 1.0), letters={"x": "y"})
except AbsoluteFactors as problem:
    assert "depth_se3" in str(problem)
else:
    raise SystemExit("merging took what is known in the other map's frame")
print("used")
"""
TURNED = """
FACTOR_KINDS = FactorKinds(reversed(FACTOR_KINDS.items()))
VARIABLE_KINDS = dict(reversed(VARIABLE_KINDS.items()))
LOSSES = LOSSES[::-1]
"""
SOLVED = """
import hashlib

from naive.random_graphs import camera_steps, random_steps
from naive.random_others import other_steps

from factorbus.solver import Options, Solver

for mode in ("bayes-tree", "inc-l"):
    for steps in (random_steps(1, steps=3), camera_steps(1, steps=3), other_steps(1, steps=3, loss="dcs")):
        solver = Solver(Options(mode=mode))
        for batch in steps:
            solver.stage(batch)
            solver.step()
        groups = sorted((g.kind, g.keys.tolist(), g.values.tobytes()) for g in solver.estimate())
        print(solver.chi2(), hashlib.sha256(repr(groups).encode()).hexdigest())
"""


def copied(folder: Path) -> Path:
    """The sources, and the twins."""
    for root in ROOTS:
        shutil.copytree(
            ROOT / root / "factorbus", folder / root / "factorbus", ignore=shutil.ignore_patterns("__pycache__")
        )
    shutil.copytree(ROOT / "tests" / "naive", folder / "tests" / "naive", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "proto" / "kinds_table.py", folder / "proto")
    shutil.copy(ROOT / "proto" / "README.md", folder / "proto")
    return folder


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Python, with the copy in place of the sources and without a compiler."""
    path = os.pathsep.join(str(folder / root) for root in (*ROOTS, "tests"))
    environment = {**os.environ, "PYTHONPATH": path, "NUMBA_DISABLE_JIT": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=280, check=False
    )


def follow(folder: Path, leave_out: str = "") -> None:
    """Write into the copy what the page says, but for the part that is left out."""
    page = (ROOT / "CONTRIBUTING.md").read_text().split("## Your first factor kind")[1]
    for text in re.findall(r"^```python\n(.*?)^```$", page, re.M | re.S):
        head, code = text.split("\n", 1)
        name, _, part = head.removeprefix("# ").partition(", in ")
        if part and part == leave_out:
            continue
        file = folder / name
        if part:
            there = file.read_text()
            assert there.count(BEHIND[part]) == 1, name
            code = there.replace(BEHIND[part], BEHIND[part] + code)
        file.write_text(code)


def test_a_kind_that_is_declared_is_on_the_wire_in_the_client_and_everywhere_else(tmp_path: Path) -> None:
    folder = copied(tmp_path)
    follow(folder)
    ran = run(folder, "-c", USED, str(len(FACTOR_KINDS)))
    assert (ran.returncode, ran.stdout) == (0, "used\n"), ran.stderr
    assert run(folder, "proto/kinds_table.py").returncode == 0
    assert "| `depth_se3` | se3 x | z in the map (metres) | t_z − z |" in (folder / "proto" / "README.md").read_text()


@pytest.mark.parametrize("part", ["FACTOR_KINDS", "FACTOR_MODELS"])
def test_a_kind_that_is_declared_in_one_place_is_an_error_at_import(tmp_path: Path, part: str) -> None:
    folder = copied(tmp_path)
    follow(folder, leave_out=part)
    ran = run(folder, "-c", "import factorbus.solver")
    assert ran.returncode == 1
    assert "ImportError: the factor kind 'depth_se3' is declared in " in ran.stderr
    assert ran.stderr.rstrip().endswith("declare it in both")


def test_the_order_of_the_declarations_means_nothing(tmp_path: Path) -> None:
    """Every table of the wire the other way round gives every code another meaning, and the same bits."""
    folder = copied(tmp_path)
    before = run(folder, "-c", SOLVED)
    assert before.returncode == 0, before.stderr
    with (folder / "proto" / "factorbus" / "proto" / "kinds.py").open("a") as file:
        file.write(TURNED)
    after = run(folder, "-c", SOLVED)
    assert after.returncode == 0, after.stderr
    assert (after.stdout, before.stdout.count("\n")) == (before.stdout, 6)


def test_a_loss_that_has_no_function_is_an_error_at_import() -> None:
    with pytest.raises(ImportError, match=r"the loss 'welsch' is declared in here but not in factorbus\.proto\.kinds"):
        check_same("loss", layout.LOSS_CODES, {**losses.LOSS_MODELS, "welsch": losses.no_loss}, "here")


def test_a_model_that_does_not_fit_its_kind_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    model = kinds.FactorModel(kinds.FACTOR_MODELS["range_se2"].residual, "", positive_at=1)
    monkeypatch.setitem(kinds.FACTOR_MODELS, "range_se2", model)
    with pytest.raises(ImportError, match="'range_se2' has a measurement of the size 1 and checks at"):
        kinds.check_kinds()


def test_an_example_has_the_numbers_that_are_measured() -> None:
    with pytest.raises(ValueError, match="'depth_se3' has the size 1, and its example 2"):
        FactorKind("depth_se3", ("se3",), 1, 1, "z", "t_z − z", (1.0, 2.0))
