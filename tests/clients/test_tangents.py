"""What rows of covariances are called: against what a step along each scalar does to a variable."""

import numpy as np
import pytest
from naive.dense_factors import boxplus, pose_matrix

from factorbus.cli.output.tangents import matrix_lines, named_sigmas, tangent_document
from factorbus.proto.variable_kinds import VARIABLE_KINDS

STEP = 1e-6
VALUES = {
    "se2": [1, 2, 0.5],
    "se3": [1, 2, 3, 0, 0, 0.6, 0.8],
    "point2": [1, 2],
    "point3": [1, 2, 3],
    "idp": [1, 2, 3, 0.1, 0.2, 0.3],
    "so3": [0, 0, 0.6, 0.8],
    "sim3": [1, 2, 3, 0, 0, 0.6, 0.8, 2],
    **{f"vector{n}": list(range(1, n + 1)) for n in range(1, 10)},
}


@pytest.mark.parametrize("kind", VARIABLE_KINDS)
def test_a_scalar_does_what_its_name_says(kind: str) -> None:
    value, scalars = np.array(VALUES[kind], float), VARIABLE_KINDS[kind].tangent
    assert len(scalars) == VARIABLE_KINDS[kind].dim == len(tangent_document(kind))
    for n, scalar in enumerate(scalars):
        after = boxplus(kind, value[None], STEP * np.eye(len(scalars))[n][None])[0]
        assert changed(kind, value, after) == scalar.name, (kind, n)


def changed(kind: str, before: np.ndarray, after: np.ndarray) -> str:
    """The name of the scalar by which a value has changed by STEP."""
    if kind.startswith("vector"):
        return f"[{int(np.argmax(np.abs(after - before)))}]"
    if kind in ("point2", "point3", "idp"):
        return ("x", "y", "z", "theta", "phi", "rho")[int(np.argmax(np.abs(after - before)))]
    if kind == "sim3" and abs(after[7] - before[7]) > 0.1 * STEP:
        assert after[7] / before[7] == pytest.approx(1 + STEP, abs=1e-9)
        return "log scale"
    if kind == "so3":
        before, after = (np.concatenate([np.zeros(3), each]) for each in (before, after))
    scale = before[7] if kind == "sim3" else 1.0
    size = 3 if kind == "se2" else 7
    moved = np.linalg.inv(pose_matrix(before[None, :size])[0]) @ pose_matrix(after[None, :size])[0]
    turned, shift = moved[:-1, :-1] - np.eye(len(moved) - 1), moved[:-1, -1] / scale
    if np.abs(shift).max() > 0.1 * STEP:
        assert np.abs(shift).max() == pytest.approx(STEP, rel=1e-3)
        return "xyz"[int(np.argmax(np.abs(shift)))]
    if kind == "se2":
        return "theta"
    turns = [turned[2, 1], turned[0, 2], turned[1, 0]]
    assert np.abs(turns).max() == pytest.approx(STEP, rel=1e-3)
    return f"r{'xyz'[int(np.argmax(np.abs(turns)))]}"


def test_sigmas_have_their_names_and_units() -> None:
    assert named_sigmas("se2", [0.1, 0.2, 0.03]) == "x 0.1 m  y 0.2 m  theta 0.03 rad"
    assert named_sigmas("vector2", [1, 2]) == "[0] 1  [1] 2"
    assert named_sigmas("idp", [1] * 6) == "x 1 m  y 1 m  z 1 m  theta 1 rad  phi 1 rad  rho 1 1/m"


def test_a_matrix_has_them_at_its_rows_and_columns() -> None:
    lines = matrix_lines([("x1", "se2"), ("l3", "point2")], np.arange(25.0).reshape(5, 5))
    assert lines[0].split() == ["x1", "x", "x1", "y", "x1", "theta", "l3", "x", "l3", "y"]
    assert lines[3].split() == ["x1", "theta", "rad", "10", "11", "12", "13", "14"]
    assert len({len(line) for line in lines}) == 1, "columns are one below the other"
