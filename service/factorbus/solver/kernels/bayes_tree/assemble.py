"""The numbers of fronts: what factors and update matrices of children bring, and those of cliques that are split.

MATH §9.5, and §9.3 for what is split.
"""

from typing import NamedTuple

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.allocator import give_numbers, size_class, take_numbers
from factorbus.solver.kernels.bayes_tree.fronts import update_layout
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.simd import TILE_ROWS, Block, Panel, add_run, zero
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import head_of, is_member
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.kernels.sparse.panels import take_off
from factorbus.solver.kernels.sparse.partial_cholesky import DAMPING, LEAST_PIVOT

# Columns of `update`, a row for each orphan: where its update matrix is, its width, and the size of its block where it
# was made for this elimination, else 0.
UPDATE_AT, UPDATE_WIDTH, UPDATE_SIZE = range(3)


class Pair(NamedTuple):
    """How many scalars the two variables of a row have, and the first column of each in a front; −1: none."""

    di: int
    dj: int
    ci: int
    cj: int


@inline_kernel
def number_columns(
    row: I64, noise: float, var: I64, node: I64, lists: I64, scalars: F64, column: I64, floors: F64
) -> None:
    """The first column of each variable of a clique, by its local number, and what each pivot is raised to."""
    width, start = 0, row[tl.C_LIST]
    for s in range(start, start + row[tl.C_FRONTALS] + row[tl.C_SEPARATORS]):
        v = lists[s]
        column[node[v, tl.N_LOCAL]] = width
        dim = dim_of_variable(var, v)
        if width < row[tl.C_PIVOTS]:
            d = var[v, at.V_SCALAR]
            for a in range(dim):
                floors[width + a] = -max(LEAST_PIVOT * scalars[1, d + a], noise)
        width += dim


@part
def damp_pivots(graph: Graph, tree: Tree, row: I64) -> None:
    """Add `DAMPING` times what its own factors bring to each pivot of a clique whose numbers are zero."""
    k = row[tl.C_ROWS]
    for s in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS]):
        v = tree.lists[s]
        d = graph.var[v, at.V_SCALAR]
        for a in range(dim_of_variable(graph.var, v)):
            tree.numbers[k] = DAMPING * tree.scalars[1, d + a]
            k += row[tl.C_LD] + 1


@inline_kernel
def variable_at(scalar: int, row: I64, var: I64, lists: I64) -> int:
    """The frontal variable of a clique that has this pivot scalar."""
    s = row[tl.C_LIST]
    scalar -= dim_of_variable(var, lists[s])
    while scalar >= 0:
        s += 1
        scalar -= dim_of_variable(var, lists[s])
    return int(lists[s])


@inline_kernel
def front_of_clique(row: I64) -> fr.Front:
    """The front that a clique is eliminated in: its separator has the right-hand side as the last column."""
    return fr.Front(
        row[tl.C_ROWS],
        row[tl.C_LD],
        row[tl.C_PIVOTS],
        row[tl.C_SEPARATOR_SCALARS] + 1,
        row[tl.C_UPDATE],
        row[tl.C_WIDTH_UPDATE],
    )


@inline_kernel
def row_of(c: int, row: I64) -> int:
    """Where column 0 of the row of column c is, in the rows of R or in the update matrix."""
    p = row[tl.C_PIVOTS]
    if c < p:
        return row[tl.C_ROWS] + c * row[tl.C_LD]
    return row[tl.C_UPDATE] + fr.update_row(c - p, row[tl.C_WIDTH_UPDATE]) - p


@part
def add_hessian(graph: Graph, tree: Tree, f: int, row: I64, column: I64) -> None:
    """Add the Hessian of factor f, its gradient and its χ² to a front."""
    var, fac = graph.var, graph.fac
    node, link, numbers, hessian = tree.node, tree.link, tree.numbers, tree.hessian
    i, j = fac[f, at.F_I], fac[f, at.F_J]
    di = dim_of_variable(var, i)
    dj = dim_of_variable(var, j) if j >= 0 else 0
    ci = column[node[i, tl.N_LOCAL]] if var[i, at.V_COLUMN] >= 0 else -1
    cj = column[node[j, tl.N_LOCAL]] if j >= 0 and var[j, at.V_COLUMN] >= 0 else -1
    if is_member(f, fac):
        has_second = fac[f, at.F_I] == fac[head_of(f, fac), at.F_I]
        add_member(has_second, Pair(di, dj, int(ci), int(cj)), link[f, tl.L_AT], row, hessian, numbers)
        return
    # Sizes as constants, so that each call becomes straight code.
    if di == 3 and dj == 3:
        _add_blocks(3, 3, ci, cj, link[f, tl.L_AT], row, hessian, numbers)
    elif di == 6 and dj == 6:
        _add_blocks(6, 6, ci, cj, link[f, tl.L_AT], row, hessian, numbers)
    elif di == 3 and dj == 2:
        _add_blocks(3, 2, ci, cj, link[f, tl.L_AT], row, hessian, numbers)
    elif di == 6 and dj == 3:
        _add_blocks(6, 3, ci, cj, link[f, tl.L_AT], row, hessian, numbers)
    else:
        _add_blocks(di, dj, ci, cj, link[f, tl.L_AT], row, hessian, numbers)


@inline_kernel
def _add_blocks(di: int, dj: int, ci: int, cj: int, h: int, row: I64, hessian: F64, numbers: F64) -> None:
    """`add_hessian` of variables of di and dj scalars, at columns ci and cj; −1: there is none, or it is fixed."""
    last = row[tl.C_PIVOTS] + row[tl.C_SEPARATOR_SCALARS]
    g = h + di * di + di * dj + dj * dj
    if ci >= 0:
        _add_diagonal(di, ci, last, h, g, row, hessian, numbers)
    if cj >= 0:
        _add_diagonal(dj, cj, last, h + di * di + di * dj, g + di, row, hessian, numbers)
    if ci >= 0 and cj >= 0:
        _add_across(di, dj, ci, cj, h + di * di, row, hessian, numbers)
    corner = row_of(last, row) + last
    numbers[corner] += hessian[g + di + dj]


@part
def add_member(has_second: bool, pair: Pair, h: int, row: I64, hessian: F64, numbers: F64) -> None:
    """The same of a further row of a factor: the block across, and what it has of its second variable where the first
    is that of the factor.  All else in such a row is zero (`hessian_of_many`).
    """
    di, dj, ci, cj = pair
    across = h + di * di
    if ci >= 0 and cj >= 0:
        if di == 6 and dj == 6:
            _add_across(6, 6, ci, cj, across, row, hessian, numbers)
        elif di == 6 and dj == 3:
            _add_across(6, 3, ci, cj, across, row, hessian, numbers)
        elif di == 3 and dj == 6:
            _add_across(3, 6, ci, cj, across, row, hessian, numbers)
        elif di == 3 and dj == 3:
            _add_across(3, 3, ci, cj, across, row, hessian, numbers)
        else:
            _add_across(di, dj, ci, cj, across, row, hessian, numbers)
    if has_second and cj >= 0:
        last, second = row[tl.C_PIVOTS] + row[tl.C_SEPARATOR_SCALARS], across + di * dj
        if dj == 6:
            _add_diagonal(6, cj, last, second, second + 36 + di, row, hessian, numbers)
        elif dj == 3:
            _add_diagonal(3, cj, last, second, second + 9 + di, row, hessian, numbers)
        else:
            _add_diagonal(dj, cj, last, second, second + dj * dj + di, row, hessian, numbers)


@inline_kernel
def _add_across(di: int, dj: int, ci: int, cj: int, h: int, row: I64, hessian: F64, numbers: F64) -> None:
    if ci < cj:
        for a in range(di):
            target = row_of(ci + a, row) + cj
            for b in range(dj):
                numbers[target + b] += hessian[h + a * dj + b]
    else:
        for b in range(dj):
            target = row_of(cj + b, row) + ci
            for a in range(di):
                numbers[target + a] += hessian[h + a * dj + b]


@inline_kernel
def _add_diagonal(d: int, c: int, last: int, h: int, g: int, row: I64, hessian: F64, numbers: F64) -> None:
    for a in range(d):
        target = row_of(c + a, row)
        for b in range(a, d):
            numbers[target + c + b] += hessian[h + a * d + b]
        numbers[target + last] += hessian[g + a]


@part
def list_column_runs(graph: Graph, tree: Tree, start: int, end: int, column: I64, p: int, m: int, runs: I64) -> int:
    """Where the columns of a child go: runs of neighbours that stay neighbours, the right-hand side last.

    A run lies wholly among the pivots or wholly in the separator of the front.  Gives how many there are.
    """
    var = graph.var
    node, lists = tree.node, tree.lists
    count, first, stop = 0, 0, -1
    for s in range(start, end):
        v = lists[s]
        into, dim = column[node[v, tl.N_LOCAL]], dim_of_variable(var, v)
        if into == stop and stop != p:
            runs[count - 1, fr.RUN_COUNT] += dim
        else:
            runs[count, fr.RUN_FIRST], runs[count, fr.RUN_COUNT], runs[count, fr.RUN_INTO] = first, dim, into
            count += 1
        stop = into + dim
        first += dim
    runs[count, fr.RUN_FIRST], runs[count, fr.RUN_COUNT], runs[count, fr.RUN_INTO] = first, 1, p + m
    return count + 1


@part
def extend_add(a: F64, child: int, width: int, runs: I64, count: int, row: I64) -> None:
    """Add the update matrix at `child`, its first rows `width` wide, into a front, run by run.

    A pair of runs in another order there is turned.
    """
    for s in range(count):
        first, length, into = runs[s, fr.RUN_FIRST], runs[s, fr.RUN_COUNT], runs[s, fr.RUN_INTO]
        for i in range(length):
            source, target = child + fr.update_row(first + i, width), row_of(into + i, row)
            add_few(a, target + into + i, source + first + i, length - i)
            for t in range(s + 1, count):
                other = runs[t, fr.RUN_INTO]
                if other > into:
                    add_few(a, target + other, source + runs[t, fr.RUN_FIRST], runs[t, fr.RUN_COUNT])
                else:
                    for j in range(runs[t, fr.RUN_COUNT]):
                        turned = row_of(other + j, row) + into + i
                        a[turned] += a[source + runs[t, fr.RUN_FIRST] + j]


@inline_kernel
def add_few(a: F64, i: int, j: int, count: int) -> None:
    """a[i : i+count] += a[j : j+count]; short runs without a call."""
    if count >= 16:
        add_run(a, i, j, count)
    else:
        for k in range(count):
            a[i + k] += a[j + k]


@part
def update_orphans(graph: Graph, tree: Tree, orphans: I64, update: I64) -> bool:
    """Where each orphan's update matrix is; those of split cliques are made.  False: no room, nothing is taken.

    update (orphans, 3): gets them, see UPDATE_AT and so on
    """
    var = graph.var
    clique, lists, numbers, state = tree.clique, tree.lists, tree.numbers, tree.state
    stamp, need = state[tl.S_STAMP], state[tl.S_NUMBERS]
    for e in range(orphans.size):
        c = orphans[e]
        update[e, UPDATE_AT], update[e, UPDATE_WIDTH], update[e, UPDATE_SIZE] = (
            clique[c, tl.C_UPDATE],
            clique[c, tl.C_WIDTH_UPDATE],
            0,
        )
        if clique[c, tl.C_MARK] == stamp:
            need += size_class(update_layout(split_sizes(c, var, clique, lists)[1])[1])[1]
    if need > numbers.size:
        state[tl.S_NEED_NUMBERS] = need
        return False
    for e in range(orphans.size):
        c = orphans[e]
        if clique[c, tl.C_MARK] == stamp:
            p, m = split_sizes(c, var, clique, lists)
            width, size = update_layout(m)
            u, size = take_numbers(size, numbers, state)
            update[e, UPDATE_AT], update[e, UPDATE_WIDTH], update[e, UPDATE_SIZE] = u, width, size
            split_update(graph, tree, c, p, m, u, width)
    return True


@part
def give_back_updates(update: I64, numbers: F64, state: I64) -> None:
    """Free what `update_orphans` made."""
    for e in range(len(update)):
        if update[e, UPDATE_SIZE] > 0:
            give_numbers(update[e, UPDATE_AT], update[e, UPDATE_SIZE], numbers, state)


@inline_kernel
def split_sizes(c: int, var: I64, clique: I64, lists: I64) -> tuple:
    """(p, m) of what is kept of a clique that is split."""
    p, start = 0, clique[c, tl.C_LIST]
    for s in range(start, start + clique[c, tl.C_FIRST]):
        p += dim_of_variable(var, lists[s])
    return p, clique[c, tl.C_PIVOTS] + clique[c, tl.C_SEPARATOR_SCALARS] - p


@part
def split_update(graph: Graph, tree: Tree, c: int, p: int, m: int, u: int, wide: int) -> None:
    """U of the first p pivots of clique c alone: what their factors and children brought, less R_Sᵀ R_S.  (9.3)

    u, wide: where it goes, and the width of its first rows
    """
    var = graph.var
    node, link, clique, lists, numbers = tree.node, tree.link, tree.clique, tree.lists, tree.numbers
    row = clique[c]
    start, kept = row[tl.C_LIST], row[tl.C_FIRST]
    width = 0
    for s in range(start, start + row[tl.C_FRONTALS] + row[tl.C_SEPARATORS]):
        node[lists[s], tl.N_COLUMN] = width - p
        width += dim_of_variable(var, lists[s])
    zero(numbers, u, fr.update_size(m + 1, wide))
    for s in range(start, start + kept):
        f = node[lists[s], tl.N_OWN]
        while f >= 0:
            _add_far_end(graph, tree, f, lists[s], m, u, wide)
            f = link[f, tl.L_OWN]
    child = row[tl.C_CHILD]
    while child >= 0:
        if clique[child, tl.C_ABOVE] < kept:
            _add_child(graph, tree, child, m, u, wide)
        child = clique[child, tl.C_NEXT]
    separators = Panel(row[tl.C_ROWS] + p, row[tl.C_LD], p)
    for i in range(0, m + 1, TILE_ROWS):
        line = Block(u + fr.update_row(i, wide), fr.update_stride(i, wide))
        take_off(numbers, min(TILE_ROWS, m + 1 - i), line, separators, i, i, m + 1, 0)


@inline_kernel
def _add_far_end(graph: Graph, tree: Tree, f: int, v: int, m: int, u: int, wide: int) -> None:
    """What a factor owned by v adds to its other end, if that is not kept, and to the corner."""
    var, fac = graph.var, graph.fac
    node, link, numbers, hessian = tree.node, tree.link, tree.numbers, tree.hessian
    i, j, h = fac[f, at.F_I], fac[f, at.F_J], link[f, tl.L_AT]
    di = dim_of_variable(var, i)
    dj = dim_of_variable(var, j) if j >= 0 else 0
    g = h + di * di + di * dj + dj * dj
    corner = u + fr.update_row(m, wide) + m
    numbers[corner] += hessian[g + di + dj]
    other = j if i == v else i
    if other < 0 or var[other, at.V_COLUMN] < 0 or node[other, tl.N_COLUMN] < 0:
        return
    c, d = node[other, tl.N_COLUMN], dj if i == v else di
    if i == v:
        h += di * di + di * dj
        g += di
    for a in range(d):
        target = u + fr.update_row(c + a, wide)
        for b in range(a, d):
            numbers[target + c + b] += hessian[h + a * d + b]
        numbers[target + m] += hessian[g + a]


@inline_kernel
def _add_child(graph: Graph, tree: Tree, child: int, m: int, u: int, wide: int) -> None:
    """Add what a child's update matrix has in the columns of the separator and the right-hand side."""
    var = graph.var
    node, clique, lists, numbers = tree.node, tree.clique, tree.lists, tree.numbers
    start = clique[child, tl.C_LIST] + clique[child, tl.C_FRONTALS]
    end, last = start + clique[child, tl.C_SEPARATORS], clique[child, tl.C_SEPARATOR_SCALARS]
    source, width = clique[child, tl.C_UPDATE], clique[child, tl.C_WIDTH_UPDATE]
    x = 0
    for s in range(start, end):
        v = lists[s]
        dim, into = dim_of_variable(var, v), node[v, tl.N_COLUMN]
        if into >= 0:
            for a in range(dim):
                line, target = source + fr.update_row(x + a, width), u + fr.update_row(into + a, wide)
                for b in range(a, dim):
                    numbers[target + into + b] += numbers[line + x + b]
                numbers[target + m] += numbers[line + last]
            y = x + dim
            for t in range(s + 1, end):
                w = lists[t]
                dims, across = dim_of_variable(var, w), node[w, tl.N_COLUMN]
                if across >= 0:
                    for a in range(dim):
                        line = source + fr.update_row(x + a, width) + y
                        for b in range(dims):
                            target = u + fr.update_row(into + a, wide) + across + b
                            if across < into:
                                target = u + fr.update_row(across + b, wide) + into + a
                            numbers[target] += numbers[line + b]
                y += dims
        x += dim
    corner = u + fr.update_row(m, wide) + m
    numbers[corner] += numbers[source + fr.update_row(last, width) + last]
