"""Δ near the bias of a measurement, and near one at which its samples were integrated, against integration anew."""

import numpy as np
import pytest
from naive.random_imu import random_imu

from factorbus.proto import inertial as of
from factorbus.proto.inertial import ImuForm
from factorbus.solver.kernels.model.imu import put_delta, put_delta_near
from factorbus.solver.kernels.model.imu_expansion import (
    MOST_MISSED,
    bias_distances,
    expand_delta,
    expand_near,
    expansion_at,
    missed,
    write_expansion,
)
from factorbus.solver.kernels.model.imu_layout import ImuLayout, imu_layout
from factorbus.solver.kernels.model.imu_noise import write_root
from factorbus.solver.kernels.model.imu_walk import walk_samples
from factorbus.solver.kernels.model.preintegration import (
    ROOM_P,
    ROOM_Q,
    ROOM_R_B,
    ROOM_T,
    ROOM_V,
    make_room,
    preintegrate,
)
from factorbus.solver.kernels.model.se3 import quat_product

SAMPLES = 50
BIAS = slice(of.NOISE, of.NOISE + of.BIAS)


def admitted(rng: np.random.Generator) -> tuple[ImuLayout, np.ndarray]:
    """A second of samples with what is kept behind them."""
    form, layout = ImuForm(SAMPLES), imu_layout(SAMPLES, False, of.MOMENTS)
    z = np.concatenate([random_imu(form, rng, 0.5), np.zeros(of.KEPT)])
    z[form.start : form.size : of.SAMPLE] = 1.0 / SAMPLES
    walk = walk_samples(layout, z)
    assert write_root(z, walk, form.size, z)
    write_expansion(layout, z, walk)
    return layout, z


def anew(layout: ImuLayout, z: np.ndarray, bias: np.ndarray) -> np.ndarray:
    room = make_room()
    preintegrate(layout, z, bias, room, True)
    return room


def off(z: np.ndarray, found: np.ndarray, wanted: np.ndarray) -> float:
    """By how many standard deviations Δ is off."""
    q, p = found[ROOM_Q : ROOM_Q + 4], wanted[ROOM_Q : ROOM_Q + 4]
    turn = quat_product(-q[0], -q[1], -q[2], q[3], p[0], p[1], p[2], p[3])
    W, size = np.zeros((9, 9)), ImuForm(SAMPLES).size
    W[np.tril_indices(9)] = z[size : size + of.ROOT]
    moved = np.subtract(wanted[ROOM_P : ROOM_V + 3], found[ROOM_P : ROOM_V + 3])
    return float(np.abs(W @ [*(2.0 * np.array(turn[:3])), *moved]).max())


def stepped(rng: np.random.Generator, gyroscopes: float, accelerometers: float) -> np.ndarray:
    return np.concatenate([rng.normal(0, gyroscopes, 3), rng.normal(0, accelerometers, 3)])


@pytest.mark.parametrize("gyroscopes", [1e-4, 1e-3, 1e-2])
def test_what_is_missed_near_the_bias_of_the_measurement_is_below_its_bound(gyroscopes: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        layout, z = admitted(rng)
        bias, room = z[BIAS] + stepped(rng, gyroscopes, 0.2), make_room()
        wanted, k = anew(layout, z, bias), expansion_at(layout)
        g, a = bias_distances(of.NOISE, z, bias, z[k])
        bound = missed(layout, z, g, a, 0.0, 0.0)
        assert expand_delta(layout, z, bias, room) == (bound <= MOST_MISSED)
        if bound <= MOST_MISSED:
            assert off(z, room, wanted) <= bound + 1e-9
            slopes, true = room[ROOM_R_B:], wanted[ROOM_R_B:]
            np.testing.assert_allclose(slopes, true, atol=1e-4 * np.abs(true).max())


def test_what_is_missed_near_another_bias_is_below_its_bound() -> None:
    rng, used = np.random.default_rng(2), 0
    for _ in range(10):
        layout, z = admitted(rng)
        there = z[BIAS] + stepped(rng, 0.01, 0.3)
        bias, kept, room = there + stepped(rng, 1e-4, 1e-2), anew(layout, z, there), make_room()
        T = kept[ROOM_T]
        bound = missed(layout, z, *bias_distances(0, kept, bias, T), *bias_distances(of.NOISE, z, there, T))
        near = expand_near(layout, z, kept, bias, room)
        assert near == (bound <= MOST_MISSED)
        if near:
            used += 1
            assert off(z, room, anew(layout, z, bias)) <= bound + 1e-9
    assert used


def test_far_away_samples_are_integrated_anew() -> None:
    rng = np.random.default_rng(3)
    layout, z = admitted(rng)
    bias = z[BIAS] + stepped(rng, 0.05, 0.5)
    wanted = anew(layout, z, bias)
    for kept in (make_room(), anew(layout, z, z[BIAS])):
        room = make_room()
        put_delta_near(layout, z, kept, bias, room)
        np.testing.assert_allclose(room, wanted, rtol=1e-13, atol=1e-15)
    room = make_room()
    put_delta(layout, z, bias, room, True)
    np.testing.assert_allclose(room, wanted, rtol=1e-13, atol=1e-15)


def test_near_a_bias_that_moved_the_second_order_is_there() -> None:
    """By 10⁻³ rad/s and 0.05 m/s²: to first order Δp is off by far more than all that is missed."""
    rng = np.random.default_rng(4)
    layout, z = admitted(rng)
    step = np.concatenate([np.full(3, 3e-4), np.full(3, 0.05)])
    before, room = anew(layout, z, z[BIAS]), make_room()
    wanted = anew(layout, z, z[BIAS] + step)
    assert expand_delta(layout, z, z[BIAS] + step, room)
    p_b = before[ROOM_R_B + 9 : ROOM_R_B + 27].reshape(3, 6)
    first_order = before[ROOM_P : ROOM_P + 3] + p_b @ step
    missing = np.abs(first_order - wanted[ROOM_P : ROOM_P + 3]).max()
    assert np.abs(room[ROOM_P : ROOM_P + 3] - wanted[ROOM_P : ROOM_P + 3]).max() < 1e-3 * missing


def test_of_a_bias_without_digits_for_a_step_samples_are_integrated() -> None:
    layout, z = admitted(np.random.default_rng(5))
    z[BIAS] = 1e11
    write_expansion(layout, z, walk_samples(layout, z))
    assert not expand_delta(layout, z, z[BIAS], make_room())
