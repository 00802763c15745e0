"""From a pattern and an elimination order to fronts: elimination tree, counts, amalgamation, maps.

The tree is Liu's with path compression; the structure of a row is found by walking the tree from its entries.  Columns
are joined into fronts bottom-up, first where no zero appears, then where few do; zeros are counted over all that was
joined so far, or a chain would collapse into one giant front.
"""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.jit.scratch import take, take_filled
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.kernels.sparse.subtrees import END, FIRST, cut_whole

NONE = -1
SMALL_PIVOTS, SMALL_ZEROS = 12, 1.0 / 3.0
ZEROS = 0.08


@kernel(
    "Tuple((int64[::1], int64[::1], int64[:,::1], int64[:,::1], int64[::1], int64[:,::1], int64[::1], float64[::1]))"
    "(int64[::1], int64[::1], int64[::1], int64[::1])"
)
def analyze_pattern(dims: I64, rows: I64, cols: I64, perm: I64) -> tuple:
    """The fronts of Λ eliminated in the order `perm`, or in one with the same fill that suits them better.

    in   dims (n,)   rows, cols (nb,): blocks, diagonal ones included   perm (n,)
    out  order (n,): variables as eliminated   place (n,): first scalar of each variable in elimination order
         fronts, runs, blocks: records (see `fronts`)   separator: scalars in elimination order
         sizes (2,): doubles of R, doubles of the arena   work (2,): nonzeros of R, flops
    """
    n = dims.size
    label, dim = np.empty(n, np.int64), np.empty(n, np.int64)
    for k in range(n):
        label[perm[k]], dim[k] = k, dims[perm[k]]
    begin, earlier = by_later(n, label, rows, cols)
    parent = elimination_tree(n, begin, earlier)
    variables, scalars = count_rows(n, begin, earlier, parent, dim)
    scratch = np.ones(1, np.int64)  # no room: arrays of their own
    top_of, pivots = join_columns(n, parent, dim, scalars, scratch)
    order, home, tops, front_of = arrange_fronts(n, perm, parent, top_of, scratch)
    work = _work(n, dim, scalars)

    first_scalar = np.empty(n + 1, np.int64)
    first_scalar[0] = 0
    for k in range(n):
        label[order[k]], dim[k] = k, dims[order[k]]
        first_scalar[k + 1] = first_scalar[k] + dim[k]
    records = make_records(tops, home, parent, front_of, pivots, scalars, first_scalar, scratch)
    sizes = _place(records)
    begin, earlier = by_later(n, label, rows, cols)
    separator_at, separator_of = list_separators(n, begin, earlier, home, tops, variables, records)
    separator = _separator_scalars(records, separator_at, separator_of, dim, first_scalar)
    runs, blocks = _maps(label, rows, cols, dim, first_scalar, separator_at, separator_of, records)
    place = np.empty(n, np.int64)
    for v in range(n):
        place[v] = first_scalar[label[v]]
    return order, place, records, runs, separator, blocks, sizes, work


@part
def by_later(n: int, label: I64, rows: I64, cols: I64) -> tuple[I64, I64]:
    """Off-diagonal blocks sorted by the end that is eliminated later; gives the other ends."""
    begin = np.zeros(n + 2, np.int64)
    for b in range(rows.size):
        if rows[b] != cols[b]:
            begin[max(label[rows[b]], label[cols[b]]) + 2] += 1
    for k in range(n):
        begin[k + 2] += begin[k + 1]
    earlier = np.empty(begin[n + 1], np.int64)
    for b in range(rows.size):
        i, j = label[rows[b]], label[cols[b]]
        if i != j:
            earlier[begin[max(i, j) + 1]] = min(i, j)
            begin[max(i, j) + 1] += 1
    return begin, earlier


@part
def elimination_tree(n: int, begin: I64, earlier: I64) -> I64:
    """The elimination tree: parent[k] is the first off-diagonal entry in row k of R."""
    parent, ancestor = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        parent[i] = ancestor[i] = NONE
        for e in range(begin[i], begin[i + 1]):
            k = earlier[e]
            while k != NONE and k < i:
                above, ancestor[k] = ancestor[k], i
                if above == NONE:
                    parent[k] = i
                k = above
    return parent


@part
def count_rows(n: int, begin: I64, earlier: I64, parent: I64, dim: I64) -> tuple[I64, I64]:
    """Off-diagonal variables and scalars in row k of R."""
    variables, scalars, seen = np.zeros(n, np.int64), np.zeros(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        seen[i] = i
        for e in range(begin[i], begin[i + 1]):
            k = earlier[e]
            while seen[k] != i:
                variables[k] += 1
                scalars[k] += dim[i]
                seen[k] = i
                k = parent[k]
    return variables, scalars


@part
def join_columns(n: int, parent: I64, dim: I64, separator: I64, scratch: I64) -> tuple[I64, I64]:
    """Join columns into fronts: the last column of each column's front, and the pivot scalars of that front."""
    into, pivots, entries = take(n, scratch), take(n, scratch), take(n, scratch)
    for k in range(n):
        into[k], pivots[k] = k, dim[k]
        entries[k] = dim[k] * (dim[k] + 1) // 2 + dim[k] * separator[k]
    for relaxed in range(2):
        for k in range(n):
            if into[k] != k or parent[k] == NONE:
                continue
            q = _top(into, parent[k])
            both = pivots[k] + pivots[q]
            room, true = both * (both + 1) // 2 + both * separator[q], entries[k] + entries[q]
            zeros = room - true
            if zeros == 0 or (
                relaxed == 1 and (zeros <= ZEROS * room or (both <= SMALL_PIVOTS and zeros <= SMALL_ZEROS * room))
            ):
                into[k], pivots[q], entries[q] = q, both, true
    for k in range(n - 1, -1, -1):
        into[k] = into[into[k]]
    return into, pivots


@inline_kernel
def _top(into: I64, k: int) -> int:
    while into[k] != k:
        into[k] = into[into[k]]
        k = into[k]
    return k


@part
def arrange_fronts(n: int, perm: I64, parent: I64, top_of: I64, scratch: I64) -> tuple[I64, I64, I64, I64]:
    """Number the fronts in postorder, their columns one after another.

    order (n,): the variables so   home (n,): the front of each   tops: the old last column of each front
    front_of (n,): the front of each old last column
    """
    child, sibling, count = take_filled(n, NONE, scratch), take_filled(n, NONE, scratch), take_filled(n, 0, scratch)
    for k in range(n - 1, -1, -1):
        count[top_of[k]] += 1
        if top_of[k] == k and parent[k] != NONE:
            above = top_of[parent[k]]
            sibling[k], child[above] = child[above], k
    front_of, tops, put, fronts, placed = take(n, scratch), take(n, scratch), take(n, scratch), 0, 0
    for root in range(n):
        if top_of[root] != root or parent[root] != NONE:
            continue
        k = root
        while k != NONE:
            if child[k] != NONE:
                below = child[k]
                child[k] = sibling[below]
                k = below
            else:
                front_of[k], tops[fronts], put[k] = fronts, k, placed
                placed += count[k]
                fronts += 1
                k = top_of[parent[k]] if parent[k] != NONE else NONE
    order, home = take(n, scratch), take(n, scratch)
    for k in range(n):
        t = top_of[k]
        order[put[t]], home[put[t]] = perm[k], front_of[t]
        front_of[k] = front_of[t]
        put[t] += 1
    return order, home, tops[:fronts], front_of


@part
def _work(n: int, dim: I64, separator: I64) -> F64:
    """Nonzeros of R and the flops to make it (the sum of squared row lengths), zeros of joined fronts not counted."""
    work = np.zeros(2)
    for k in range(n):
        for i in range(dim[k]):
            row = float(separator[k] + dim[k] - i)
            work[0] += row
            work[1] += row * row
    return work


@part
def make_records(
    tops: I64, home: I64, parent: I64, front_of: I64, pivots: I64, separator: I64, first_scalar: I64, scratch: I64
) -> I64:
    """The front records without places and maps."""
    records = take_filled(tops.size * fr.FRONT, 0, scratch).reshape((tops.size, fr.FRONT))
    for k in range(home.size - 1, -1, -1):
        records[home[k], fr.VARIABLE], records[home[k], fr.COLUMN] = k, first_scalar[k]
    for f in range(tops.size - 1, -1, -1):
        front, above = records[f], parent[tops[f]]
        front[fr.PIVOTS], front[fr.SEPARATOR] = pivots[tops[f]], separator[tops[f]]
        front[fr.PARENT] = front_of[above] if above != NONE else NONE
        front[fr.CHILD] = front[fr.SIBLING] = NONE
        if above != NONE:
            above = front_of[above]
            front[fr.SIBLING], records[above, fr.CHILD] = records[above, fr.CHILD], f
    return records


@part
def _place(records: I64) -> I64:
    """Give the rows of R and the update matrices their places; gives the doubles of R and of the whole arena.

    Update matrices live on two stacks, those of even and of odd depth: when a front is made its children lie on top of
    the one and it goes on top of the other, so nothing is ever moved.  Subtrees that other threads may factorize have
    two stacks of their own, each.
    """
    fronts = records.shape[0]
    cut = cut_whole(records)
    stack = np.zeros(fronts, np.int64)
    for k in range(len(cut)):
        stack[cut[k, FIRST] : cut[k, END]] = 2 * (k + 1)
    for f in range(fronts - 1, -1, -1):
        above = records[f, fr.PARENT]
        if above != NONE:
            stack[f] += (stack[above] + 1) % 2
    stacks = 2 * (len(cut) + 1)
    top, peak, end = np.zeros(stacks, np.int64), np.zeros(stacks, np.int64), fr.SCRATCH
    for f in range(fronts):
        front = records[f]
        p, m = front[fr.PIVOTS], front[fr.SEPARATOR]
        front[fr.LD_ROWS], front[fr.WIDTH_UPDATE] = fr.row_stride(fr.padded_size(p) + m), fr.padded_size(m)
        front[fr.ROWS] = end + fr.padded_size(p) - p
        end += p * front[fr.LD_ROWS]
        c = front[fr.CHILD]
        while c != NONE and stack[c] != stack[f] ^ 1:
            c = records[c, fr.SIBLING]
        if c != NONE:
            top[stack[c]] = records[c, fr.UPDATE]
        front[fr.UPDATE] = top[stack[f]]
        top[stack[f]] += fr.update_size(m, front[fr.WIDTH_UPDATE])
        peak[stack[f]] = max(peak[stack[f]], top[stack[f]])
    begin = np.empty(stacks + 1, np.int64)
    begin[0] = end
    for k in range(stacks):
        begin[k + 1] = begin[k] + peak[k]
    for f in range(fronts):
        records[f, fr.UPDATE] += begin[stack[f]]
    sizes = np.empty(2, np.int64)
    sizes[0], sizes[1] = end, begin[stacks]
    return sizes


@part
def list_separators(
    n: int, begin: I64, earlier: I64, home: I64, tops: I64, variables: I64, records: I64
) -> tuple[I64, I64]:
    """The separator variables of each front, ascending: walk the tree of fronts from every entry of every row."""
    fronts = tops.size
    at = np.zeros(fronts + 1, np.int64)
    for f in range(fronts):
        at[f + 1] = at[f] + variables[tops[f]]
    of, put, seen = np.empty(at[fronts], np.int64), at[:fronts].copy(), np.full(fronts, NONE)
    for i in range(n):
        seen[home[i]] = i
        for e in range(begin[i], begin[i + 1]):
            f = home[earlier[e]]
            while seen[f] != i:
                of[put[f]] = i
                put[f] += 1
                seen[f] = i
                f = records[f, fr.PARENT]
    return at, of


@part
def _separator_scalars(records: I64, separator_at: I64, separator_of: I64, dim: I64, first_scalar: I64) -> I64:
    """The separator scalars of each front, ascending."""
    total = 0
    for f in range(records.shape[0]):
        records[f, fr.SEPARATOR_AT] = total
        total += records[f, fr.SEPARATOR]
    separator, put = np.empty(total, np.int64), 0
    for e in range(separator_at[-1]):
        for i in range(dim[separator_of[e]]):
            separator[put] = first_scalar[separator_of[e]] + i
            put += 1
    return separator


@part
def _maps(
    label: I64, rows: I64, cols: I64, dim: I64, first_scalar: I64, separator_at: I64, separator_of: I64, records: I64
) -> tuple[I64, I64]:
    """Where the blocks of Λ and the update matrices of the children go, front by front."""
    n, fronts = dim.size, records.shape[0]
    begin, block_of = _by_earlier(n, label, rows, cols)
    column = np.empty(n, np.int64)  # of the variables of the present front
    runs, blocks = np.empty((separator_of.size, fr.RUN), np.int64), np.empty((rows.size, fr.BLOCK), np.int64)
    run, block = 0, 0
    for f in range(fronts):
        front = records[f]
        first, last = front[fr.VARIABLE], records[f + 1, fr.VARIABLE] if f + 1 < fronts else n
        width = 0
        for k in range(first, last):
            column[k] = width
            width += dim[k]
        for e in range(separator_at[f], separator_at[f + 1]):
            column[separator_of[e]] = width
            width += dim[separator_of[e]]
        front[fr.BLOCKS] = block
        for e in range(begin[first], begin[last]):
            b = block_of[e]
            _block(blocks[block], b, label[rows[b]], label[cols[b]], dim, column, front)
            block += 1
        front[fr.BLOCKS_END] = block
        c = front[fr.CHILD]
        while c != NONE:
            records[c, fr.RUNS] = run
            run = _runs(runs, run, separator_of, separator_at[c], separator_at[c + 1], dim, column, front[fr.PIVOTS])
            records[c, fr.RUNS_END] = run
            c = records[c, fr.SIBLING]
    return runs[:run].copy(), blocks


@part
def _by_earlier(n: int, label: I64, rows: I64, cols: I64) -> tuple[I64, I64]:
    """Blocks sorted by the end that is eliminated first."""
    begin = np.zeros(n + 2, np.int64)
    for b in range(rows.size):
        begin[min(label[rows[b]], label[cols[b]]) + 2] += 1
    for k in range(n):
        begin[k + 2] += begin[k + 1]
    block_of = np.empty(rows.size, np.int64)
    for b in range(rows.size):
        k = min(label[rows[b]], label[cols[b]])
        block_of[begin[k + 1]] = b
        begin[k + 1] += 1
    return begin, block_of


@inline_kernel
def _block(out: I64, b: int, i: int, j: int, dim: I64, column: I64, front: I64) -> None:
    """Block b of Λ, between the variables labelled i and j, as `front` takes it in."""
    upper, later = min(i, j), max(i, j)
    out[fr.BLOCK_NUMBER] = b
    out[fr.BLOCK_AT] = front[fr.ROWS] + column[upper] * front[fr.LD_ROWS] + column[later]
    out[fr.BLOCK_ROWS], out[fr.BLOCK_COLUMNS] = dim[upper], dim[later]
    out[fr.BLOCK_TURN] = fr.DIAGONAL if i == j else (fr.STRAIGHT if i < j else fr.TURNED)


@inline_kernel
def _runs(runs: I64, run: int, separator_of: I64, begin: int, end: int, dim: I64, column: I64, pivots: int) -> int:
    """Join neighbours of a child's separator that stay neighbours in the parent; gives the next free run."""
    first, stop = 0, NONE
    for e in range(begin, end):
        v = separator_of[e]
        if column[v] == stop and stop != pivots:
            runs[run - 1, fr.RUN_COUNT] += dim[v]
        else:
            runs[run, fr.RUN_FIRST], runs[run, fr.RUN_COUNT], runs[run, fr.RUN_INTO] = first, dim[v], column[v]
            run += 1
        stop = column[v] + dim[v]
        first += dim[v]
    return run
