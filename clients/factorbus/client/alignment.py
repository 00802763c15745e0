"""Where one map lies in another, of candidate relative poses of which many may be false.

    A_i, B_i   candidate i is between pose A_i of map a and pose B_i of map b, each in its map's frame
    z_i        what was measured: B_i as seen from A_i
    T          where the frame of b lies in that of a; a right candidate has T = A_i z_i B_i⁻¹, but for noise

Two candidates are consistent if the loop z_i⁻¹ A_i⁻¹ A_j z_j B_j⁻¹ B_i comes back to where it began, within three
standard deviations of what was measured and of what both maps know of their own poses (Mangelson et al. 2018, pairwise
consistency).  The largest set of which each is consistent with each other one gives T by least squares, weighted with
the covariance of all residuals r_i = Log(z_i⁻¹ A_i⁻¹ T B_i) together.  A further candidate joins the set where that
raises its χ² by no more than the quantile; one of the set leaves where χ² falls by more.

The set is believed if such a set would come about by chance less than `MOST_BY_CHANCE` times, were the false ones
anywhere, and if among all others there is no set that is not by chance either and has half as many.  One that is not is
set aside, and the largest of the others is looked at.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from factorbus.client.largest_clique import largest_clique
from factorbus.proto.arrays import F64, I64

# The quantiles of χ² that three standard deviations of one number are, 99.73 %, by the number of scalars.
THREE_SIGMAS = {3: 14.156, 6: 20.062}
FEWEST = 3  # places that agree: two may be one mistake made twice
MOST_BY_CHANCE = 1e-3  # sets, expected
RIVAL_SHARE = 0.5  # of the members of the largest set
_MOST_ROUNDS, _MOST_JOINING, _MOST_ASIDE = 20, 5, 5
ALIGNED, AMBIGUOUS, TOO_FEW = "aligned", "ambiguous", "too_few"


class CandidatePoses(NamedTuple):
    """CandidatePoses between two maps, as matrices: poses (n, k, k), k = 3 in the plane and 4 in space.

    a, b: the poses of their maps; z: as measured, (n, k, k).  noise (n, d, d): of z, in its tangent space, metres and
    radians.  known_a, known_b (n d, n d): the joint covariance of a, and of b.  pairs (n, 2): keys of a and b.
    """

    a: F64
    b: F64
    z: F64
    noise: F64
    known_a: F64
    known_b: F64
    pairs: I64


class _Fit(NamedTuple):
    T: F64
    covariance: F64
    chi2: float


@dataclass(frozen=True, slots=True)
class AgreeingSet:
    """CandidatePoses that agree, and where they put the other map.

    members (m,): which, ascending.  T: T_a_b, a matrix.  reference: the member in their midst.  covariance (d, d): of
    the pose B of the reference as seen from its pose A, in the tangent space of that, metres and radians.
    by_chance: how many sets of this size are expected among as many candidates, were all of them false.
    """

    members: I64
    T: F64
    reference: int
    covariance: F64
    by_chance: float

    def sigmas(self) -> tuple[float, float]:
        """The largest standard deviation of that place, metres, and angle, radians."""
        size = len(self.T) - 1
        place, turn = self.covariance[:size, :size], self.covariance[size:, size:]
        return math.sqrt(float(np.linalg.eigvalsh(place)[-1])), math.sqrt(float(np.linalg.eigvalsh(turn)[-1]))


class Judgement(NamedTuple):
    """verdict: ALIGNED, AMBIGUOUS or TOO_FEW.  best: the largest set, None where no two agree; rival: of the others."""

    verdict: str
    best: AgreeingSet | None
    rival: AgreeingSet | None


def judge(candidates: CandidatePoses) -> Judgement:
    """Find the largest set that agrees, and whether it is to be believed."""
    everyone = np.arange(len(candidates.z))
    best = first = _largest_set(candidates, everyone, everyone.size)
    others = everyone if first is None else np.setdiff1d(everyone, first.members)
    # A large set may be one guess between two poses, made again and again: it says no more than once.
    for _ in range(_MOST_ASIDE):
        if best is None or _is_believed(candidates, best):
            break
        best = _largest_set(candidates, others, everyone.size)
        others = others if best is None else np.setdiff1d(others, best.members)
    if best is None or not _is_believed(candidates, best):
        rest = everyone if first is None else np.setdiff1d(everyone, first.members)
        return Judgement(TOO_FEW, first, _largest_set(candidates, rest, rest.size))
    rival = _largest_set(candidates, others, others.size)
    if rival is not None and _is_believed(candidates, rival) and _differs(candidates, best, rival):
        places, of_rival = _count_places(candidates, best.members), _count_places(candidates, rival.members)
        if of_rival >= RIVAL_SHARE * places:
            return Judgement(AMBIGUOUS, best, rival)
    return Judgement(ALIGNED, best, rival)


def gap_between(one: F64, other: F64) -> tuple[float, float]:
    """How far two poses are apart, metres, and turned, radians."""
    left = log_of(_inverse(one) @ other)
    size = len(one) - 1
    return float(np.linalg.norm(left[:size])), float(np.linalg.norm(left[size:]))


def log_of(T: F64) -> F64:
    """The tangent (..., d) of rigid motions (..., k, k): translation, then the rotation vector."""
    if T.shape[-1] == 3:
        return np.concatenate([T[..., :2, 2], np.arctan2(T[..., 1, 0], T[..., 0, 0])[..., None]], axis=-1)
    R = T[..., :3, :3]
    skew = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    twice_sine = np.linalg.norm(skew, axis=-1)
    angle = np.arctan2(twice_sine, np.trace(R, axis1=-2, axis2=-1) - 1.0)
    # Half a turn has no axis in `skew`; no candidate is consistent there, whatever the axis.
    scale = np.where(twice_sine > 1e-9, angle / np.maximum(twice_sine, 1e-300), 0.5)
    turn = skew * scale[..., None]
    turn[..., 0] = np.where((twice_sine <= 1e-9) & (angle > 1.0), np.pi, turn[..., 0])
    return np.concatenate([T[..., :3, 3], turn], axis=-1)


def adjoint_of(T: F64) -> F64:
    """Ad of rigid motions (..., k, k), (..., d, d): T exp(x) = exp(Ad x) T."""
    k = T.shape[-1]
    out = np.zeros((*T.shape[:-2], 3 * (k - 2), 3 * (k - 2)))
    if k == 3:
        out[..., :2, :2] = T[..., :2, :2]
        out[..., 0, 2], out[..., 1, 2], out[..., 2, 2] = T[..., 1, 2], -T[..., 0, 2], 1.0
        return out
    R, t = T[..., :3, :3], T[..., :3, 3]
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = np.cross(t[..., None, :], np.swapaxes(R, -1, -2)).swapaxes(-1, -2)
    return out


def are_consistent(c: CandidatePoses) -> np.ndarray:
    """(n, n) bool: whether two candidates say the same, within three standard deviations."""
    n, d = len(c.z), c.noise.shape[1]
    i, j = np.triu_indices(n, 1)
    to_i = _inverse(c.z[i])
    a_ij, b_ji = _inverse(c.a[i]) @ c.a[j], _inverse(c.b[j]) @ c.b[i]
    before = to_i @ a_ij @ c.z[j]
    loop = before @ b_ji
    of_a = np.concatenate([-adjoint_of(to_i), adjoint_of(to_i @ a_ij)], axis=-1)
    back = adjoint_of(before)
    of_b = np.concatenate([adjoint_of(loop), -back], axis=-1)
    covariance = c.noise[i] + back @ c.noise[j] @ back.swapaxes(1, 2)
    covariance += _of_pairs(of_a, c.known_a, i, j, d) + _of_pairs(of_b, c.known_b, i, j, d)
    r = log_of(loop)
    d2 = np.einsum("na,na->n", r, np.linalg.solve(covariance, r[..., None])[..., 0])
    out = np.zeros((n, n), bool)
    out[i, j] = out[j, i] = d2 <= THREE_SIGMAS[d]
    return out


def _of_pairs(jacobian: F64, known: F64, i: I64, j: I64, d: int) -> F64:
    """J Σ Jᵀ of each pair, Σ (2d, 2d) of i and j."""
    blocks = known.reshape(-1, d, known.shape[0] // d, d).swapaxes(1, 2)
    both = np.concatenate(
        [np.concatenate([blocks[i, i], blocks[i, j]], axis=-1), np.concatenate([blocks[j, i], blocks[j, j]], axis=-1)],
        axis=-2,
    )
    return jacobian @ both @ jacobian.swapaxes(1, 2)


def _largest_set(c: CandidatePoses, among: I64, count: int) -> AgreeingSet | None:
    """The largest set among some candidates, which were chosen of `count`; None where no two agree."""
    if among.size < 2:
        return None
    taken = _taken(c, among)
    members = largest_clique(are_consistent(taken))
    if len(members) < 2:
        return None
    reference = _in_their_midst(taken, members)
    residuals = _Residuals(_seen_from(taken, reference))
    members, fit = _refined(residuals, members, residuals.fit(members))
    by_chance = _expected_by_chance(count, _count_places(taken, members), _chance(taken, residuals))
    T = taken.a[reference] @ fit.T @ _inverse(taken.b[reference])
    return AgreeingSet(among[members], T, int(among[reference]), fit.covariance, by_chance)


def _in_their_midst(c: CandidatePoses, members: Sequence[int]) -> int:
    """The member whose pose is nearest to the middle of all."""
    places = c.a[members, :-1, -1]
    return members[int(np.linalg.norm(places - np.median(places, axis=0), axis=1).argmin())]


def _seen_from(c: CandidatePoses, reference: int) -> CandidatePoses:
    """The same with the poses of each map as seen from that of one candidate.

    How the whole map lies is certain then.  In a map whose heading is uncertain by 0.1 rad a pose 40 m from where it
    begins is 0.2 m off by the second order of that alone, which no covariance of first order has.
    """
    a, known_a = _poses_from(c.a, c.known_a, reference)
    b, known_b = _poses_from(c.b, c.known_b, reference)
    return c._replace(a=a, b=b, known_a=known_a, known_b=known_b)


def _poses_from(poses: F64, known: F64, reference: int) -> tuple[F64, F64]:
    n, d = len(poses), len(known) // len(poses)
    seen = _inverse(poses[reference]) @ poses
    J = np.zeros((n, d, n, d))
    J[np.arange(n), :, np.arange(n)] = np.eye(d)
    J[:, :, reference] -= adjoint_of(_inverse(seen))
    J = J.reshape(n * d, n * d)
    return seen, J @ known @ J.T


def _refined(residuals: _Residuals, members: list[int], fit: _Fit) -> tuple[list[int], _Fit]:
    """Those that agree with the set join it; then those leave, the worst first, that do not."""
    quantile = THREE_SIGMAS[residuals.dim]
    for _ in range(_MOST_JOINING):
        others = np.setdiff1d(np.arange(len(residuals.c.z)), members)
        joining = others[residuals.rises(others, members, fit) <= quantile]
        if not joining.size:
            break
        members = sorted([*members, *joining.tolist()])
        fit = residuals.fit(members)
    while len(members) > FEWEST:
        falls = residuals.falls(members, fit)
        if falls.max() <= quantile:
            break
        members = [m for k, m in enumerate(members) if k != int(falls.argmax())]
        fit = residuals.fit(members)
    return members, fit


class _Residuals:
    """r_i = Log(z_i⁻¹ A_i⁻¹ T B_i), what it is by T, and its covariance together with all others'."""

    def __init__(self, c: CandidatePoses) -> None:
        self.c, self.dim = c, c.noise.shape[1]
        n, d = len(c.z), self.dim
        of_a, covariance = np.zeros((n, d, n, d)), np.zeros((n, d, n, d))
        of_a[np.arange(n), :, np.arange(n)] = adjoint_of(_inverse(c.z))
        covariance[np.arange(n), :, np.arange(n)] = c.noise
        of_a = of_a.reshape(n * d, n * d)
        self._covariance = covariance.reshape(n * d, n * d) + of_a @ c.known_a @ of_a.T + c.known_b
        self._by_T = adjoint_of(_inverse(c.b))
        self._to_b = _inverse(c.z) @ _inverse(c.a)

    def own_covariance(self) -> F64:
        """(n, d, d): of each residual by itself."""
        n, d = len(self.c.z), self.dim
        return self._covariance.reshape(n, d, n, d)[np.arange(n), :, np.arange(n)]

    def at(self, T: F64, members: Sequence[int]) -> F64:
        """r (m, d) of some candidates."""
        return log_of(self._to_b[members] @ T @ self.c.b[members])

    def rises(self, others: I64, members: Sequence[int], fit: _Fit) -> F64:
        """By how much χ² would rise for each of the others, were it one of the members: of the linear model at T."""
        if not others.size:
            return np.empty(0)
        rows, d = self._rows(members), self.dim
        gain = np.linalg.solve(self._covariance[np.ix_(rows, rows)], self._covariance[rows])
        by_members, at_members = self._by_T[np.asarray(members)].reshape(-1, d), self.at(fit.T, members).ravel()
        out = np.empty(others.size)
        for n, k in enumerate(others.tolist()):
            own = slice(k * d, k * d + d)
            G = self._by_T[k] - gain[:, own].T @ by_members
            gap = self.at(fit.T, [k])[0] - gain[:, own].T @ at_members
            covariance = self._covariance[own, own] - self._covariance[own, rows] @ gain[:, own]
            out[n] = gap @ np.linalg.solve(covariance + G @ fit.covariance @ G.T, gap)
        return out

    def falls(self, members: Sequence[int], fit: _Fit) -> F64:
        """By how much χ² would fall without each of the members."""
        rows, d = self._rows(members), self.dim
        weight = np.linalg.inv(self._covariance[np.ix_(rows, rows)])
        of_T = weight @ self._by_T[np.asarray(members)].reshape(-1, d)
        weight -= of_T @ fit.covariance @ of_T.T
        e, each = (weight @ self.at(fit.T, members).ravel()).reshape(-1, d), range(len(members))
        blocks = np.array([weight[k * d : k * d + d, k * d : k * d + d] for k in each])
        return np.einsum("na,na->n", e, np.linalg.solve(blocks, e[..., None])[..., 0])

    def _rows(self, members: Sequence[int]) -> I64:
        return (np.asarray(members)[:, None] * self.dim + np.arange(self.dim)).ravel()

    def fit(self, members: Sequence[int]) -> _Fit:
        """T by weighted least squares, of these alone."""
        d, each, rows = self.dim, np.asarray(members), self._rows(members)
        half = np.linalg.cholesky(self._covariance[np.ix_(rows, rows)])
        J = np.linalg.solve(half, self._by_T[each].reshape(-1, d))
        T = self.c.a[each[0]] @ self.c.z[each[0]] @ _inverse(self.c.b[each[0]])
        for _ in range(_MOST_ROUNDS):
            r = np.linalg.solve(half, self.at(T, members).ravel())
            step = -np.asarray(np.linalg.lstsq(J, r, rcond=None)[0], np.float64)
            T = T @ exp_of(step)
            if np.abs(step).max() < 1e-9:
                break
        r = np.linalg.solve(half, self.at(T, members).ravel())
        return _Fit(T, np.asarray(np.linalg.inv(J.T @ J), np.float64), float(r @ r))


def exp_of(x: F64) -> F64:
    """The rigid motion of one tangent: its rotation, and its translation as it stands."""
    if x.size == 3:
        c, s = math.cos(x[2]), math.sin(x[2])
        return np.array([[c, -s, x[0]], [s, c, x[1]], [0, 0, 1.0]])
    angle = float(np.linalg.norm(x[3:]))
    K = np.array([[0, -x[5], x[4]], [x[5], 0, -x[3]], [-x[4], x[3], 0]])
    sine, versed = (math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2) if angle > 1e-6 else (1.0, 0.5)
    T = np.eye(4)
    T[:3, :3] += sine * K + versed * K @ K
    T[:3, 3] = x[:3]
    return T


def _chance(c: CandidatePoses, residuals: _Residuals) -> float:
    """How likely a false candidate puts the other map where a given one does, within the quantile.

    A false one puts it anywhere that the places of the candidates, in both maps, lead to, and turned in any way about
    the vertical: the share of that space that three standard deviations take up.
    """
    size = len(c.z[0]) - 1
    both = 2.0 * residuals.own_covariance()
    place = np.linalg.eigvalsh(both[:, :size, :size])
    turn = np.sqrt(np.linalg.eigvalsh(both[:, size:, size:])[:, -1])
    reach = 3.0 * np.sqrt(place)
    extent = np.ptp(c.a[:, :size, size], axis=0) + np.ptp(c.b[:, :size, size], axis=0)
    shares = np.minimum(2.0 * reach / np.maximum(extent.max(), 2.0 * reach), 1.0)
    if size == 3:  # how high it is says little where the robot drives on the ground
        shares = shares[:, 1:]
    return float(np.mean(np.prod(shares, axis=1) * np.minimum(3.0 * turn / math.pi, 1.0)))


def _expected_by_chance(count: int, places: int, chance: float) -> float:
    """The expected number of sets of `places` among `count` false candidates: the first is anywhere, others agree."""
    if places < 1:
        return math.inf
    logarithm = math.lgamma(count + 1) - math.lgamma(places + 1) - math.lgamma(count - places + 1)
    return math.exp(min(logarithm + (places - 1) * math.log(max(chance, 1e-300)), 700.0))


def _is_believed(c: CandidatePoses, found: AgreeingSet) -> bool:
    return _count_places(c, found.members) >= FEWEST and found.by_chance <= MOST_BY_CHANCE


def _count_places(c: CandidatePoses, members: Sequence[int] | I64) -> int:
    """Pairs of poses: two candidates between the same two say it once."""
    return len(np.unique(c.pairs[np.asarray(members)], axis=0))


def _differs(c: CandidatePoses, one: AgreeingSet, other: AgreeingSet) -> bool:
    """Whether they put the reference of the first at two places."""
    b = c.b[one.reference]
    r = log_of(_inverse(b) @ _inverse(one.T) @ other.T @ b)
    moved = adjoint_of(_inverse(b) @ c.b[other.reference])
    return float(r @ np.linalg.solve(one.covariance + moved @ other.covariance @ moved.T, r)) > THREE_SIGMAS[r.size]


def _taken(c: CandidatePoses, among: I64) -> CandidatePoses:
    d = c.noise.shape[1]
    rows = (among[:, None] * d + np.arange(d)).ravel()
    square = np.ix_(rows, rows)
    return CandidatePoses(
        c.a[among], c.b[among], c.z[among], c.noise[among], c.known_a[square], c.known_b[square], c.pairs[among]
    )


def _inverse(T: F64) -> F64:
    out = np.zeros_like(T)
    back = np.swapaxes(T[..., :-1, :-1], -1, -2)
    out[..., :-1, :-1] = back
    out[..., :-1, -1] = -(back @ T[..., :-1, -1:])[..., 0]
    out[..., -1, -1] = 1.0
    return out
