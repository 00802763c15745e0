"""The loss of a closure whose kernel is graduated from convex to Geman-McClure's, and how it is put into a map.

McGann, Rogers and Kaess, "Robust incremental smoothing and mapping (riSAM)", ICRA 2023, give each factor the scale
invariant graduated kernel with a control parameter μ, of s = rᵀ Ω r,

    ρ_μ(s) = c² s / (c² + s^μ),      w_μ(s) = ρ_μ'(s) = c² (c² + (1 − μ) s^μ) / (c² + s^μ)²                  (12.1)

μ = 0 is quadratic, whatever the scale of s, and μ = 1 Geman-McClure's loss of scale c.  The map has the loss
geman-mcclure of scale k for every μ: that whose weight is w_μ at the present estimate,

    (k² / (k² + s))² = w_μ(s)      k² = s √w / (1 − √w),   at least c²                                      (12.2)

so k = c where μ = 1, and the fixed point is that of Geman-McClure's loss.
"""

from collections.abc import Sequence

import numpy as np

from factorbus.solver.closures.loops import SplitFactors
from factorbus.solver.graph.groups import Addition, BatchLike, FactorGroup, FactorsLike
from factorbus.solver.kernels.jit.compile import F64

GRADUATED_LOSS = "geman-mcclure"
# μ of riSAM's schedule, μ + 1.2 (μ + 0.1), from 0 to 1.
CONTROL_PARAMETERS = (0.0, 0.12, 0.384, 0.9648, 1.0)
_LEAST_CHI2, _LEAST_SHARE = 1e-9, 1e-9  # where (12.2) divides by nothing


def sig_weights(chi2: F64, mu: float, c2: float) -> F64:
    """w_μ(s), (12.1)."""
    power = np.maximum(chi2, _LEAST_CHI2) ** mu
    return np.asarray(c2 * (c2 + (1.0 - mu) * power) / (c2 + power) ** 2, np.float64)


def scales_at(chi2: F64, mu: float, c2: float) -> F64:
    """k, (12.2), of closures with these rᵀ Ω r."""
    if mu >= 1.0:
        return np.full(chi2.shape, np.sqrt(c2))
    root = np.sqrt(np.minimum(sig_weights(chi2, mu, c2), 1.0 - _LEAST_SHARE))
    return np.sqrt(np.maximum(np.maximum(chi2, _LEAST_CHI2) * root / (1.0 - root), c2))


def final_weights(chi2: F64, c2: float) -> F64:
    """w_1(s): a quarter where s = c²."""
    return np.asarray((c2 / (c2 + chi2)) ** 2, np.float64)


def chi2_of_weights(weights: F64, c2: float) -> F64:
    """s of which these are the final weights."""
    return np.asarray(c2 * (1.0 / np.sqrt(weights) - 1.0), np.float64)


def with_scale(factor: FactorsLike, scale: float) -> FactorGroup:
    """A closure with the loss of this scale."""
    return FactorGroup(factor.kind, factor.keys, factor.measured, factor.information, GRADUATED_LOSS, np.array([scale]))


def graduated_split(split: SplitFactors) -> SplitFactors:
    """Without those that have a loss of their own: their sender weighs them."""
    kept = [k for k, factor in enumerate(split.closing) if not factor.loss]
    if len(kept) == len(split.closing):
        return split
    return split._replace(closing=[split.closing[k] for k in kept], places=[split.places[k] for k in kept])


def with_final_loss(batch: BatchLike, split: SplitFactors, c: dict[str, float]) -> Addition:
    """`batch`, in its order, with the final loss on the closures of `split`; c: its scale by kind of factor."""
    closes = np.zeros(split.count, bool)
    closes[split.places] = True
    groups, before = list[FactorsLike](), 0
    for group in batch.factors:
        own = closes[before : before + len(group.keys)]
        before += len(group.keys)
        groups += [group] if not own.any() else _cut(group, own, c[group.kind])
    return Addition(batch.variables, groups)


def _cut(group: FactorsLike, closes: np.ndarray, scale: float) -> Sequence[FactorGroup]:
    """Runs of rows that close loops, and of those that do not, in their order."""
    made = list[FactorGroup]()
    for rows in np.split(np.arange(closes.size), np.flatnonzero(np.diff(closes)) + 1):
        picked = FactorGroup(group.kind, group.keys[rows], group.measured[rows], group.information[rows])
        if closes[rows[0]]:
            made.append(picked._replace(loss=GRADUATED_LOSS, scale=np.full(rows.size, scale)))
        else:
            made.append(picked._replace(loss=group.loss, scale=None if group.scale is None else group.scale[rows]))
    return made
