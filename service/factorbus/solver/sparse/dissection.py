"""An order by nested dissection, for whole graphs of which minimum degree leaves R too much to do.  MATH §5.

METIS finds it (the extra `batch`); without it minimum degree stays.  For whole graphs only: a step orders what it
affects anew each time, and has the same bits whether or not METIS is installed.
"""

from importlib.util import find_spec

import numpy as np

from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.sparse.child_order import with_few_waiting
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import Symbolic, analyze

# METIS takes some 2 µs for each block of a pose graph's Λ, in which a core makes 8e4 operations of an elimination, and
# saves three quarters of them in large graphs: it is asked where all eliminations together have more than this for each
# block.  Not by variables: of cameras and points there are tens of blocks to each, and METIS saves nothing there.
_WORTH_ASKING = 1.1e5


def analyze_whole(dims: I64, rows: I64, cols: I64, times: int = 1) -> Symbolic:
    """As `analyze`, by whichever order makes R by less, minimum degree or nested dissection, and in little memory.

    dims (n,): scalars of each variable.  rows, cols (nb,): the blocks of Λ.  times: how often it will be eliminated,
    about.  Raises ValueError as `analyze`.
    """
    symbolic = analyze(dims, rows, cols, order(dims, rows, cols))
    if times * symbolic.flops <= _WORTH_ASKING * len(rows) or find_spec("pymetis") is None:
        return with_few_waiting(symbolic, rows, cols)
    dissected = analyze(dims, rows, cols, dissect(dims, rows, cols))
    return with_few_waiting(dissected if dissected.flops < symbolic.flops else symbolic, rows, cols)


def dissect(dims: I64, rows: I64, cols: I64) -> I64:
    """The order of METIS, by how many scalars separators have: the variable eliminated k-th.  Raises ImportError."""
    import pymetis
    from scipy.sparse import csr_array

    off = rows != cols
    ends = np.concatenate([rows[off], cols[off]]), np.concatenate([cols[off], rows[off]])
    graph = csr_array((np.ones(ends[0].size, np.int8), ends), shape=(len(dims), len(dims)))
    begins, others = (np.asarray(each, np.int32).ravel() for each in (graph.indptr, graph.indices))
    adjacency = pymetis.CSRAdjacency(begins, others)
    weights = None if (dims == dims[0]).all() else dims.astype(np.int32)
    found, _ = pymetis.nested_dissection(adjacency, vweights=weights)
    return np.asarray(found, np.int64)
