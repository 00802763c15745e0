"""How far out a lens model is one to one.  workers/MATH.md §2"""

import math
from collections.abc import Sequence

import numpy as np

from factorbus.solver.lenses import layout as at

# No lens sees that far from its axis: a limit where the model has none.
UNLIMITED = 1e9


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
    roots = np.roots(np.trim_zeros((1.0, *slope)[::-1], "f"))
    real = roots.real[(abs(roots.imag) <= 1e-9 * abs(roots)) & (roots.real > 0.0)]
    return min(math.sqrt(real.min()), UNLIMITED) if real.size else UNLIMITED
