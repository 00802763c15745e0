"""What speaks for relative poses that close loops, of which some are false.  Numbers in, numbers out.

    A_i, B_i   the two poses of closure i, as the map has them      z_i   what was measured: B_i as seen from A_i
    r_i = Log(z_i⁻¹ A_i⁻¹ B_i)            S_i = Ω_i⁻¹ + J Σ Jᵀ,  J = [−Ad(B_i⁻¹ A_i) | I],  Σ of both poses
    d²_i = rᵀ S⁻¹ r                       χ² of d numbers, if the closure is right and the map is

Two closures agree if the loop z_i⁻¹ (A_i⁻¹ A_j) z_j (B_j⁻¹ B_i) comes back to where it began, within the quantile: what
the map is wrong in alike at both is not in it.

First order is not enough where a map is uncertain: over a lever that makes σ_p of a heading σ_θ the second-order term
of the position is σ_p θ² / (2 σ_θ); its mean square, with E θ⁴ = 3 σ_θ⁴, is added to the variance along every axis.

A closure that is false may agree by chance.  What speaks for that are the odds of its residual: how likely it is of a
false closure, which is anywhere up to `spread_m` off along each axis and `spread_rad` about each, for how likely it is
of a right one,

    p = (2π)^{3/2} √|S| e^{d²/2} / (8 spread_m² spread_rad),   at most 1.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from factorbus.solver.closures.motions import adjoint_motion, inverse_motion, motions_of_poses, tangent_of
from factorbus.solver.kernels.closures.plane import (
    FULL,
    HELD,
    MOST_DISTANCE,
    SECOND_ORDER,
    judge_each_plane,
    judge_pairs_plane,
    weights_without_plane,
)
from factorbus.solver.kernels.jit.compile import F64, I64

_PLANE = 3
_ALONE = 1e-6  # of Ω⁻¹


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
    """d² (n,), the odds of residuals (n, spreads), and S (n, d, d)."""

    distance: F64
    chance: F64
    allowed: F64


def judge_each(c: ClosureNumbers, spreads: Sequence[FalseSpread]) -> Evidence:
    """Each by itself against the map; the chances are of `spreads`, one after the other, (n, spreads)."""
    n, d = c.noise.shape[:2]
    if d == _PLANE:
        out = np.empty((n, 4, 3))
        judge_each_plane(*map(np.ascontiguousarray, c), out)
        return _in_plane(out, spreads)
    there, r = _residuals(c)
    J = _jacobians(there)
    S = c.noise + _with_second_order(J @ _own_blocks(c) @ J.swapaxes(1, 2))
    return _in_space(r, S, spreads)


def judge_pairs(c: ClosureNumbers, i: I64, j: I64, spreads: Sequence[FalseSpread]) -> Evidence:
    """Closures i[k] and j[k] against each other."""
    d = c.noise.shape[1]
    if d == _PLANE:
        out = np.empty((i.size, 4, 3))
        judge_pairs_plane(*map(np.ascontiguousarray, c), i, j, out)
        return _in_plane(out, spreads)
    to_i, a_ij, b_ji = inverse_motion(c.z[i]), inverse_motion(c.a[i]) @ c.a[j], inverse_motion(c.b[j]) @ c.b[i]
    before = to_i @ a_ij @ c.z[j]
    loop, back = before @ b_ji, adjoint_motion(before)
    # In the order a_i, b_i, a_j, b_j, as increments at the start of the loop.
    J = np.concatenate([-adjoint_motion(to_i), adjoint_motion(loop), adjoint_motion(to_i @ a_ij), -back], axis=-1)
    blocks = c.known.reshape(-1, 2 * d, len(c.z), 2 * d)
    rows = [np.concatenate([blocks[p, :, q] for q in (i, j)], axis=-1) for p in (i, j)]
    S = c.noise[i] + back @ c.noise[j] @ back.swapaxes(1, 2)
    S += _with_second_order(J @ np.concatenate(rows, axis=-2) @ J.swapaxes(1, 2))
    return _in_space(tangent_of(loop), S, spreads)


def judge_accepted(c: ClosureNumbers) -> F64:
    """d² (n,) of closures that the map has, each against what the map is without it: rᵀ (Ω⁻¹ − J Σ Jᵀ)⁻¹ r.

    That is of first order; where the closure alone holds what it measures nothing speaks against it: 0.
    """
    M, r = exact_weights_without(c), _residuals(c)[1]
    return np.einsum("na,nab,nb->n", r, M, r)


def weights_without(c: ClosureNumbers) -> F64:
    """(Ω⁻¹ − J Σ Jᵀ)⁻¹ (n, d, d) of closures that the map has; axes that one alone holds are left out."""
    if c.noise.shape[1] != _PLANE:
        return exact_weights_without(c)
    out = np.empty(c.noise.shape)
    weights_without_plane(*map(np.ascontiguousarray, (c.a, c.b, c.noise, c.known)), out)
    return out


def exact_weights_without(c: ClosureNumbers) -> F64:
    """The same; 0 along any direction that the closure alone holds."""
    d = c.noise.shape[1]
    J = _jacobians(_residuals(c)[0])
    half = np.linalg.cholesky(c.noise)
    back = np.linalg.inv(half)
    own = back @ (J @ _own_blocks(c) @ J.swapaxes(1, 2)) @ back.swapaxes(1, 2)
    left, Q = np.linalg.eigh(np.eye(d) - 0.5 * (own + own.swapaxes(1, 2)))
    white = Q.swapaxes(1, 2) @ back
    share = np.where(left > HELD, 1.0 / np.maximum(left, HELD), 0.0)
    return np.asarray(white.swapaxes(1, 2) @ (share[..., None] * white), np.float64)


def numbers_without(c: ClosureNumbers, gone: int) -> ClosureNumbers:
    """Closures `gone` and later, as the map has them without the first ones, to first order: δ = G M r, Σ + G M Gᵀ.

    With H the Jacobians of all that go, G = Σ Hᵀ, M = (Ω⁻¹ − H G)⁻¹.  A millionth of Ω holds what they alone hold.
    """
    n, d = c.noise.shape[:2]
    there, r = _residuals(c)
    H = np.zeros((gone, d, n, 2 * d))
    H[np.arange(gone), :, np.arange(gone)] = _jacobians(there)[:gone]
    H = H.reshape(gone * d, -1)
    left = np.zeros((gone, d, gone, d))
    left[np.arange(gone), :, np.arange(gone)] = (1.0 + _ALONE) * c.noise[:gone]
    G = c.known @ H.T
    gain = np.linalg.solve(left.reshape(gone * d, -1) - H @ G, G.T).T
    moved = (gain @ r[:gone].reshape(-1)).reshape(n, 2, d)[gone:]
    a, b = (_moved(T[gone:], moved[:, end]) for end, T in enumerate((c.a, c.b)))
    first = 2 * d * gone
    return ClosureNumbers(a, b, c.z[gone:], c.noise[gone:], (c.known + gain @ G.T)[first:, first:])


def odds_without(c: ClosureNumbers, spread: FalseSpread) -> F64:
    """p (n,) of closures in the plane that the map has, each against the map without it: S = Ω⁻¹ W Ω⁻¹.

    NaN where one alone holds what it measures: the estimate does not say how unsure the map is without it.
    """
    W, r = weights_without(c), _residuals(c)[1]
    size = np.linalg.det(W)
    root = np.sqrt(np.where(size > 0.0, size, np.nan)) * np.linalg.det(c.noise)
    distance = np.einsum("na,nab,nb->n", r, W, r)
    return _odds(FULL * root * np.exp(0.5 * np.minimum(distance, MOST_DISTANCE)), [spread])[:, 0]


def odds_of_weights(W: F64, distance: F64, spread: FalseSpread) -> F64:
    """p (n,) of closures in the plane with S⁻¹ = W."""
    root = 1.0 / np.sqrt(np.linalg.det(W))
    return _odds(FULL * root * np.exp(0.5 * np.minimum(distance, MOST_DISTANCE)), [spread])[:, 0]


def volume_of(spread: FalseSpread) -> float:
    """Of where false ones are, metres² radians."""
    return 8.0 * spread.metres**2 * spread.radians


def _odds(volume: F64, spreads: Sequence[FalseSpread]) -> F64:
    """(n, spreads): p where false ones are as likely as a right one in this volume."""
    return np.minimum(volume[:, None] / np.array([volume_of(spread) for spread in spreads]), 1.0)


def _in_plane(out: F64, spreads: Sequence[FalseSpread]) -> Evidence:
    return Evidence(out[:, 0, 0].copy(), _odds(out[:, 0, 1], spreads), out[:, 1:])


def _in_space(r: F64, S: F64, spreads: Sequence[FalseSpread]) -> Evidence:
    """How high a false one is, and how it tilts, counts for nothing: a robot drives on a floor.  So half of d² does."""
    distance = np.einsum("...a,...a->...", r, np.linalg.solve(S, r[..., None])[..., 0])
    place, turn = _axes(S)
    root = np.sqrt(place[..., -1] * place[..., -2] * turn[..., -1])
    volume = FULL * root * np.exp(0.25 * np.minimum(distance, MOST_DISTANCE))
    return Evidence(distance, _odds(volume, spreads), S)


def _residuals(c: ClosureNumbers) -> tuple[F64, F64]:
    """A⁻¹ B, and r."""
    there = inverse_motion(c.a) @ c.b
    return there, tangent_of(inverse_motion(c.z) @ there)


def _jacobians(there: F64) -> F64:
    """J of each."""
    back = adjoint_motion(inverse_motion(there))
    return np.concatenate([-back, np.broadcast_to(np.eye(back.shape[-1]), back.shape)], axis=-1)


def _moved(T: F64, x: F64) -> F64:
    """T exp(x) with the translation as it stands, for turns that are small."""
    size = T.shape[-1] - 1
    step = np.zeros(T.shape)
    step[:, np.arange(size + 1), np.arange(size + 1)] = 1.0
    step[:, :size, size] = x[:, :size]
    if size == 2:
        c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
        step[:, 0, 0], step[:, 0, 1], step[:, 1, 0], step[:, 1, 1] = c, -s, s, c
        return T @ step
    half = 0.5 * x[:, 3:]
    q = np.concatenate([half, np.ones((len(x), 1))], axis=1)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    step[:, :3, :3] = motions_of_poses(np.concatenate([x[:, :3], q], axis=1))[:, :3, :3]
    return T @ step


def _own_blocks(c: ClosureNumbers) -> F64:
    """Σ of the two poses of each."""
    n, d = c.noise.shape[:2]
    return c.known.reshape(n, 2 * d, n, 2 * d)[np.arange(n), :, np.arange(n)]


def _with_second_order(P: F64) -> F64:
    """What is allowed of places (..., d, d), with the second order of headings."""
    place, turn = _axes(P)
    out, each = P.copy(), np.arange(place.shape[-1])
    out[..., each, each] += SECOND_ORDER * place[..., -1:] * turn[..., -1:]
    return out


def _axes(P: F64) -> tuple[F64, F64]:
    """The variances of places along their axes, and of turns, ascending, in space."""
    place, turn = (np.asarray(np.linalg.eigvalsh(P[..., of, of]), np.float64) for of in (slice(3), slice(3, 6)))
    return np.maximum(place, 0.0), np.maximum(turn, 0.0)
