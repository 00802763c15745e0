"""The sparsity of Λ and of its factor R, block by block, and what the elimination order does to it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.viz import style
from factorbus.wording import counted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_PIXELS = 400  # a side; blocks of larger systems share pixels
_FAINTEST = 0.5


@dataclass(frozen=True, slots=True)
class Pattern:
    """Blocks of Λ and R of n variables.  order (n,): which is eliminated first, by place in the order of keys.

    inserted (m, 2): blocks of Λ off its diagonal, rows and columns in the order of keys.  eliminated (m, 2): the
    same blocks in the order of elimination.  fill (k, 2): blocks that R has and Λ has not, in that order.
    nnz_lambda, nnz_r: scalars in the upper triangles.  nnz_unordered: of R without a change of order.
    """

    n: int
    order: I64
    inserted: I64
    eliminated: I64
    fill: I64
    nnz_lambda: int
    nnz_r: int
    nnz_unordered: int


def sparsity_figure(pattern: Pattern, title: str = "") -> "Figure":
    """Λ in the order of keys, Λ as it is eliminated, and R, as a matplotlib figure of its own."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    before = f"{counted(pattern.nnz_lambda, 'nonzero')}; R would have {pattern.nnz_unordered:,}"
    after = f"{counted(pattern.nnz_r, 'nonzero')}, {counted(len(pattern.fill), 'block')} of fill-in"
    same = "the same blocks, rows and columns permuted"
    panels = (
        ("Λ, in the order of keys", before, _both(pattern.inserted), None),
        ("Λ, in the order of elimination", same, _both(pattern.eliminated), None),
        ("R", after, pattern.eliminated, pattern.fill),
    )
    framed: dict[Any, Any] = {"axes.grid": False, "axes.spines.right": True, "axes.spines.top": True}
    with mpl.rc_context(style.SETTINGS | framed):
        figure = Figure(figsize=(13.5, 5.4), layout="constrained")
        for column, (name, caption, blocks, fill) in enumerate(panels):
            axes = figure.add_subplot(1, 3, column + 1)
            _draw(axes, pattern.n, blocks, fill)
            axes.set_title(name, loc="left", fontsize=11, pad=20)
            axes.text(0, 1.015, caption, transform=axes.transAxes, fontsize=8.5, color="#555555")
        _legend(figure)
        figure.suptitle(title, x=0.008, ha="left", fontsize=13)
    return figure


def _both(blocks: I64) -> I64:
    """A symmetrical pattern from the pairs of its upper triangle."""
    return np.concatenate([blocks, blocks[:, ::-1]])


def _draw(axes: Any, n: int, blocks: I64, fill: I64 | None) -> None:
    """Blocks in one colour, fill-in in another below them; darker where more blocks share a pixel."""
    side = min(n, _MOST_PIXELS)
    diagonal = np.repeat(np.arange(n)[:, None], 2, axis=1)
    image = np.ones((side, side, 3))
    if fill is not None:
        _paint(image, _counts(fill, n, side), style.ODOMETRY)
    _paint(image, _counts(np.concatenate([blocks, diagonal]), n, side), style.ESTIMATE)
    axes.imshow(image, extent=(0, n, n, 0), interpolation="nearest")
    axes.tick_params(length=2)
    axes.set_xlabel(counted(n, "block column"))


def _counts(blocks: I64, n: int, side: int) -> F64:
    """Blocks in each pixel (side, side)."""
    at = blocks * side // max(n, 1)
    return np.bincount(at[:, 0] * side + at[:, 1], minlength=side * side).reshape(side, side).astype(float)


def _paint(image: F64, counts: F64, colour: str) -> None:
    from matplotlib.colors import to_rgb

    there = counts > 0
    share = np.minimum(counts[there] / np.percentile(counts[there], 90), 1.0) if there.any() else counts[there]
    cover = (_FAINTEST + (1 - _FAINTEST) * share)[:, None]
    image[there] = (1 - cover) * image[there] + cover * np.array(to_rgb(colour))


def _legend(figure: "Figure") -> None:
    from matplotlib.patches import Patch

    handles = [Patch(color=style.ESTIMATE, label="block of Λ"), Patch(color=style.ODOMETRY, label="fill-in")]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
