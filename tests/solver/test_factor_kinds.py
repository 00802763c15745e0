"""Every kind of factor: its residual and Jacobians against the dense twin, its names and sizes against the wire's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.dense_derived import base_ends, is_derived, parts_of, with_further
from naive.dense_factors import jacobians, pose_matrix, pose_vector, residual
from naive.random_camera_factors import CAMERA_KINDS, random_camera_factor
from naive.random_graphs import random_information, random_value
from naive.random_lenses import LENS_KINDS, random_lens_factor
from naive.random_others import LINEAR, OTHERS, SIMILAR_ENDS, random_other

from examples import examples
from factorbus.proto import kinds as wire
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factors import FACTOR_KINDS, FactorKind
from factorbus.solver.graph.linearized import linearized_factor
from factorbus.solver.graph.variables import VARIABLE_KINDS
from factorbus.solver.kernels.model import layout as at

seeds = st.integers(0, 2**32 - 1)
# With a twin that is slow, and one mechanism for all of them: each is tried less often.
CALIBRATED = [name for name in FACTOR_KINDS if is_derived(name) and not name.endswith("_mount")]
every_kind = pytest.mark.parametrize(
    "kind", [FACTOR_KINDS[name] for name in (*FACTOR_KINDS, *LINEAR) if name not in CALIBRATED], ids=str
)
calibrated_kind = pytest.mark.parametrize("kind", [FACTOR_KINDS[name] for name in CALIBRATED], ids=str)


def base_of(kind: FactorKind) -> str:
    """The kind that it is with further variables, or itself."""
    return parts_of(kind.name)[0] if is_derived(kind.name) else kind.name


def drawn(kind: FactorKind, rng: np.random.Generator) -> np.ndarray:
    """A measurement of anything: a pose or a point, or near the example of the declaration."""
    if kind.size == kind.connects[0].size and kind.name.endswith(SIMILAR_ENDS):
        return random_value(kind.connects[0].name, rng)
    of = {2: "point2", 3: "se2", 7: "se3"}.get(kind.size)
    if of is None:
        return np.array(wire.FACTOR_KINDS[kind.name].example) + rng.normal(0, 0.1, kind.size)
    return random_value(of, rng)


def case(kind: FactorKind, seed: int) -> tuple[list[np.ndarray], np.ndarray, FactorGraph]:
    """Values of the ends, a measurement far from them, and a graph of that one factor."""
    rng = np.random.default_rng(seed)
    base = base_of(kind)
    if kind.name in LENS_KINDS:
        ends, z = random_lens_factor(kind.name, rng, "radtan")
        base = kind.name
    elif base in CAMERA_KINDS:
        _, ends, z = random_camera_factor(base, rng)
    else:
        ends = [random_value(end.name, rng) for end in FACTOR_KINDS[base].connects]
        z = random_other(base, ends, 1.0, rng) if base in OTHERS else drawn(FACTOR_KINDS[base], rng)
    if base != kind.name:
        z = with_further(kind.name, z, rng)
        ends += [random_value(end.name, rng) for end in kind.connects[len(ends) :]]
    if base in CAMERA_KINDS and base != kind.name:  # the robot that has the sensor there
        at_origin = np.array([0, 0, 0, 0, 0, 0, 1.0])
        sensor = pose_matrix(base_ends(kind.name, [at_origin, *ends[1:]], z)[0][0])
        ends[0] = pose_vector(pose_matrix(ends[0]) @ np.linalg.inv(sensor))
    if base == "bearing_range_se2":
        z[:2] = z[0] % 3.0, abs(z[1]) + 0.1
    graph = FactorGraph()
    admit(
        graph,
        Batch(
            tuple(Variables(end.name, np.array([k]), ends[k][None]) for k, end in enumerate(kind.connects)),
            (Factors(kind.name, np.arange(len(ends))[None], z[None], random_information(kind.dim, rng)[None]),),
        ),
    )
    return ends, z, graph


def evaluate(kind: FactorKind, graph: FactorGraph) -> tuple[np.ndarray, list[np.ndarray]]:
    linear = linearized_factor(graph, 0)
    return linear.r, [linear.jacobian_of(v) for v in range(len(kind.connects))]


@every_kind
@given(seed=seeds)
def test_residual_and_jacobians_are_the_twins(kind: FactorKind, seed: int) -> None:
    check(kind, seed)


@calibrated_kind
@examples(30)
@given(seed=seeds)
def test_residual_and_jacobians_by_further_variables_are_the_twins(kind: FactorKind, seed: int) -> None:
    check(kind, seed)


def check(kind: FactorKind, seed: int) -> None:
    ends, z, graph = case(kind, seed)
    r, found = evaluate(kind, graph)
    check_residual(kind, r, residual(kind.name, ends, z))
    check_jacobians(kind, ends, z, r, found)


def check_residual(kind: FactorKind, r: np.ndarray, twin: np.ndarray) -> None:
    near_turn = (np.abs(np.abs(twin) - np.pi) < 1e-9) & (
        "_seen" not in kind.name and kind.name not in CAMERA_KINDS
    )  # −π and π are the same angle
    np.testing.assert_allclose(np.where(near_turn, np.abs(r), r), np.where(near_turn, np.abs(twin), twin), atol=1e-9)


def check_jacobians(
    kind: FactorKind, ends: list[np.ndarray], z: np.ndarray, r: np.ndarray, found: list[np.ndarray]
) -> None:
    """Central differences of the twin's residual, where they have a meaning."""
    base = base_of(kind)
    seen = base_ends(kind.name, ends, z)[0] if base != kind.name else ends
    names = [end.name for end in kind.connects]
    if base in CAMERA_KINDS:
        for J, twin in zip(found, jacobians(kind.name, names, ends, z, 1e-4), strict=True):
            np.testing.assert_allclose(J, twin, rtol=1e-6, atol=5e-5)  # hundreds of pixels per radian
        return
    if base in OTHERS and (base.startswith("bearing") or kind.dim == 6):
        if any(
            np.linalg.norm(end[: len(seen[1])] - seen[1]) < 0.3 for end in seen[:1] if len(seen) == 2 and kind.dim != 6
        ):
            return  # a direction changes without bound near the pose
    elif wire.FACTOR_KINDS[kind.name].half_angles and base.endswith(SIMILAR_ENDS):
        turn = r[wire.FACTOR_KINDS[kind.name].half_angle_rows]
        if 1.0 - turn @ turn < 1e-3:
            return  # the same of rotations alone, and of similarities
    elif kind.dim == 6 and base not in LINEAR and 1.0 - r[3:] @ r[3:] < 1e-3:
        return  # half a turn apart: the sign of the error quaternion flips within the differences
    if (
        kind.dim != 6
        and base not in LINEAR
        and not base.endswith(SIMILAR_ENDS)
        and np.abs(np.abs(r) - np.pi).min() < 1e-3
    ):
        return  # the angle wraps within the differences
    if base == "bearing_range_se2" and r[1] + z[1] < 0.1:
        return  # a bearing changes without bound near the pose
    for J, twin in zip(found, jacobians(kind.name, names, ends, z), strict=True):
        np.testing.assert_allclose(J, twin, atol=3e-7)


def test_a_point_on_the_pose_has_no_bearing_but_no_nan_either() -> None:
    kind = FACTOR_KINDS["bearing_range_se2"]
    _, _, graph = case(kind, 1)
    graph.values[3:5] = graph.values[0:2]
    r, found = evaluate(kind, graph)
    assert np.isfinite(r).all()
    assert all((J == 0.0).all() for J in found)


@pytest.mark.parametrize("space", ["se2", "se3"])
def test_poses_on_top_of_each_other_have_a_range_but_no_direction(space: str) -> None:
    kind = FACTOR_KINDS[f"range_between_{space}"]
    _, z, graph = case(kind, 1)
    n = 2 if space == "se2" else 3
    second = graph.var[1, at.V_AT]
    graph.values[second : second + n] = graph.values[:n]
    r, found = evaluate(kind, graph)
    np.testing.assert_array_equal(r, -z)
    assert all((J == 0.0).all() for J in found)


def test_the_wire_and_the_solver_mean_the_same_kinds() -> None:
    assert {k.name: (k.size, k.dim) for k in VARIABLE_KINDS.values()} == {
        k.name: (k.size, k.dim) for k in wire.VARIABLE_KINDS.values()
    }
    assert {k.name: (tuple(map(str, k.connects)), k.size, k.dim, k.triangle) for k in FACTOR_KINDS.values()} == {
        k.name: (k.connects, k.size, k.dim, k.information_size) for k in wire.FACTOR_KINDS.values()
    }
