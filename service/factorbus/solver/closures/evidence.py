"""What speaks for relative poses that close loops, of which some are false.  Numbers in, numbers out.

    A_i, B_i   the two poses of closure i, as the map has them      z_i   what was measured: B_i as seen from A_i
    r_i = Log(z_i⁻¹ A_i⁻¹ B_i)            S_i = Ω_i⁻¹ + J Σ Jᵀ,  J = [−Ad(B_i⁻¹ A_i) | I],  Σ of both poses
    d²_i = rᵀ S⁻¹ r                       χ² of d numbers, if the closure is right and the map is

Two closures agree if the loop z_i⁻¹ (A_i⁻¹ A_j) z_j (B_j⁻¹ B_i) comes back to where it began, within the quantile: what
the map is wrong in alike at both is not in it.

First order is not enough where a map is uncertain: over a lever that makes σ_p of a heading σ_θ the second-order term
of the position is σ_p θ² / (2 σ_θ); its mean square, with E θ⁴ = 3 σ_θ⁴, is added to the variance along every axis.

A closure that is false may agree by chance.  Its chance to do so is the share that the gate takes of where false ones
are: up to `spread_m` off along each axis, and `spread_rad` about each.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from factorbus.solver.closures.motions import adjoint_motion, inverse_motion, tangent_of
from factorbus.solver.kernels.jit.compile import F64, I64

_SECOND_ORDER = 0.75  # of σ_p² σ_θ²
_HELD = 1e-3  # a share of Ω⁻¹: below, the map is what the closure says


class ClosureNumbers(NamedTuple):
    """Closures of one kind of pose.

    a, b, z (n, k, k): as above.  noise (n, d, d): Ω⁻¹ in the tangent space of z, metres and radians.
    known (2 n d, 2 n d): the joint covariance of a_0, b_0, a_1, b_1, ...
    """

    a: F64
    b: F64
    z: F64
    noise: F64
    known: F64


class FalseSpread(NamedTuple):
    """How far off false closures are: metres along each axis, radians about each."""

    metres: float
    radians: float


class Evidence(NamedTuple):
    """d² (n, ...) and the chance of false ones to be within the quantile."""

    distance: F64
    chance: F64


def judge_each(c: ClosureNumbers, quantile: float, spreads: Sequence[FalseSpread]) -> Evidence:
    """Each by itself against the map; the chances are of `spreads`, one after the other, (n, spreads)."""
    n, d = c.noise.shape[:2]
    there = inverse_motion(c.a) @ c.b
    r = tangent_of(inverse_motion(c.z) @ there)
    J = np.concatenate([-adjoint_motion(inverse_motion(there)), np.broadcast_to(np.eye(d), (n, d, d))], axis=-1)
    blocks = c.known.reshape(n, 2 * d, n, 2 * d)[np.arange(n), :, np.arange(n)]
    S = c.noise + _with_second_order(J @ blocks @ J.swapaxes(1, 2))
    return Evidence(_squared(r, S), _chances(S, quantile, spreads))


def judge_pairs(c: ClosureNumbers, i: I64, j: I64, quantile: float, spreads: Sequence[FalseSpread]) -> Evidence:
    """Closures i[k] and j[k] against each other."""
    d = c.noise.shape[1]
    to_i, a_ij, b_ji = inverse_motion(c.z[i]), inverse_motion(c.a[i]) @ c.a[j], inverse_motion(c.b[j]) @ c.b[i]
    before = to_i @ a_ij @ c.z[j]
    loop, back = before @ b_ji, adjoint_motion(before)
    # In the order a_i, b_i, a_j, b_j, as increments at the start of the loop.
    J = np.concatenate([-adjoint_motion(to_i), adjoint_motion(loop), adjoint_motion(to_i @ a_ij), -back], axis=-1)
    blocks = c.known.reshape(-1, 2 * d, len(c.z), 2 * d)
    rows = [np.concatenate([blocks[p, :, q] for q in (i, j)], axis=-1) for p in (i, j)]
    S = c.noise[i] + back @ c.noise[j] @ back.swapaxes(1, 2)
    S += _with_second_order(J @ np.concatenate(rows, axis=-2) @ J.swapaxes(1, 2))
    return Evidence(_squared(tangent_of(loop), S), _chances(S, quantile, spreads))


def judge_accepted(c: ClosureNumbers) -> F64:
    """d² (n,) of closures that the map has, each against what the map is without it: rᵀ (Ω⁻¹ − J Σ Jᵀ)⁻¹ r.

    That is of first order; where the closure alone holds what it measures nothing speaks against it: 0.
    """
    n, d = c.noise.shape[:2]
    there = inverse_motion(c.a) @ c.b
    r = tangent_of(inverse_motion(c.z) @ there)
    J = np.concatenate([-adjoint_motion(inverse_motion(there)), np.broadcast_to(np.eye(d), (n, d, d))], axis=-1)
    blocks = c.known.reshape(n, 2 * d, n, 2 * d)[np.arange(n), :, np.arange(n)]
    half = np.linalg.cholesky(c.noise)
    white = np.linalg.solve(half, np.concatenate([J @ blocks @ J.swapaxes(1, 2), r[..., None]], axis=-1))
    own = np.linalg.solve(half, white[..., :d].swapaxes(1, 2))
    left, Q = np.linalg.eigh(np.eye(d) - 0.5 * (own + own.swapaxes(1, 2)))
    y = (Q.swapaxes(1, 2) @ white[..., d:])[..., 0]
    return np.where(left > _HELD, y * y / np.maximum(left, _HELD), 0.0).sum(axis=1)


def _with_second_order(P: F64) -> F64:
    """What is allowed of places (..., d, d), with the second order of headings."""
    place, turn = _axes(P)
    out, each = P.copy(), np.arange(place.shape[-1])
    out[..., each, each] += _SECOND_ORDER * place[..., -1:] * turn[..., -1:]
    return out


def _squared(r: F64, S: F64) -> F64:
    """rᵀ S⁻¹ r."""
    return np.einsum("...a,...a->...", r, np.linalg.solve(S, r[..., None])[..., 0])


def _chances(S: F64, quantile: float, spreads: Sequence[FalseSpread]) -> F64:
    """(..., spreads): the share of false ones that are within the quantile.

    In space how high one is, and how it tilts, count for nothing: a robot drives on a floor.
    """
    reach, (place, turn) = math.sqrt(quantile), _axes(S)
    axes = np.sqrt(np.concatenate([place[..., -2:], turn[..., -1:]], axis=-1))
    each = [axes / np.array([s.metres, s.metres, s.radians]) for s in spreads]
    return np.minimum(reach * np.stack(each, axis=-2), 1.0).prod(axis=-1)


def _axes(P: F64) -> tuple[F64, F64]:
    """The variances of places along their axes, and of turns, ascending."""
    if P.shape[-1] == 6:
        place, turn = (np.asarray(np.linalg.eigvalsh(P[..., of, of]), np.float64) for of in (slice(3), slice(3, 6)))
        return place, turn
    mean, half = 0.5 * (P[..., 0, 0] + P[..., 1, 1]), 0.5 * (P[..., 0, 0] - P[..., 1, 1])
    off = np.hypot(half, P[..., 0, 1])
    return np.maximum(np.stack([mean - off, mean + off], axis=-1), 0.0), np.maximum(P[..., 2:, 2], 0.0)
