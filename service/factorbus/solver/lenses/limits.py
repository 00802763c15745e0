"""How far out a lens model is one to one.  workers/MATH.md §2"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorbus.solver.lenses import layout as at

# No lens sees that far from its axis: a limit where the model has none.
UNLIMITED = 1e9
# Below that share of the others a leading coefficient makes numbers too large for eigenvalues, or no numbers at all.
_LEAST_LEADING = 1e-12


def limit_of(code: int, more: Sequence[float]) -> float:
    """The radius up to which the model is one to one; `more`: its numbers from `layout.MORE` on."""
    if code == at.RADIAL:
        return _first_turn((3.0 * more[2], 5.0 * more[3]))
    if code == at.FISHEYE:
        return min(_first_turn([k * (2 * i + 3) for i, k in enumerate(more[:4])]), math.pi)
    k1, k2, _, _, k3 = more[:5]
    return _first_turn((3.0 * k1, 5.0 * k2, 7.0 * k3))


def _first_turn(slope: Sequence[float]) -> float:
    """The smallest r > 0 where the slope 1 + s₁ r² + s₂ r⁴ + … of the radial function is 0; UNLIMITED if nowhere."""
    falling = np.trim_zeros((1.0, *slope)[::-1], "f")
    if abs(falling[0]) >= _LEAST_LEADING * max(map(abs, falling)):
        real = _positive(np.roots(falling))
        return min(math.sqrt(real.min()), UNLIMITED) if real.size else UNLIMITED
    inverse = _positive(np.roots((1.0, *slope)))  # 1/r² is a root of 1 + s₁ … read backwards, whose leading one is 1
    return min(1.0 / math.sqrt(inverse.max()), UNLIMITED) if inverse.size else UNLIMITED


def _positive(roots: Any) -> NDArray[np.float64]:
    """Those of `roots` that are real and above 0."""
    return roots.real[(abs(roots.imag) <= 1e-9 * abs(roots)) & (roots.real > 0.0)]
