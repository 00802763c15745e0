"""Which variables' blocks of covariance a step changes, so that what hangs on no changed one is left as it is."""

from typing import NamedTuple

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, part
from factorbus.solver.covariance.kernels.squares import row_length
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree

# A change of a block by less than this share of a variance is not followed down the tree.  Over 3,500 updates that
# adds nothing to the 2·10⁻⁹ that rounding leaves.
NEGLIGIBLE = 3e-10


class BlockChanges(NamedTuple):
    """The present step, and at (n,): the last step that changed each variable's block by more than NEGLIGIBLE."""

    at: I64
    step: int


@inline_kernel
def has_changed_separator(tree: Tree, c: int, changes: BlockChanges) -> bool:
    """Whether this step changed the block of a variable in the separator of clique c."""
    row, lists, at = tree.clique[c], tree.lists, changes.at
    s = row[tl.C_LIST] + row[tl.C_FRONTALS]
    end = s + row[tl.C_SEPARATORS]
    while s < end and at[lists[s]] != changes.step:
        s += 1
    return s < end


@part
def mark_changed(tree: Tree, c: int, dims: I64, a: F64, target: int, changes: BlockChanges, blocks: F64) -> None:
    """Compare the frontals' `blocks` with those in the square of clique c at `target`."""
    row, lists, scalar = tree.clique[c], tree.lists, 0
    ld = row_length(row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS])
    for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS]):
        v = lists[s]
        d, block, corner = dims[v], blocks[v], target + scalar * ld + scalar
        scalar += d
        for i in range(d):
            for j in range(i, d):
                change, scale = a[corner + i * ld + j] - block[i, j], a[corner + i * (ld + 1)]
                if change * change > NEGLIGIBLE * NEGLIGIBLE * scale * a[corner + j * (ld + 1)]:
                    changes.at[v] = changes.step
