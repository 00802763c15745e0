"""Back-substitution from the new roots down, as far as anything changes.  MATH §9.7.

A clique that was there before is solved again only when its separator has changed its shape by more than
`wildfire_threshold` standard deviations since the clique was solved last.  Where it has moved by more as a whole, all
below moves along.  So what is left undone never adds up over the steps.
"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree import rigid_subtrees as rg
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.move_estimate import MODEL, move_variable, note_moved
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.work import SOLVING, note_work, work_of_solving
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.prefetch import prefetch
from factorbus.solver.kernels.jit.scratch import take, take_floats
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph

QUIET = 0.05  # of P_RELINEARIZE_THRESHOLD: a turn with a smaller error is not counted
LINE = 8  # numbers of a cache line
LEAST_SHARE = 0.125  # of the budget, which back-substitution has whatever came before it
SURROUNDINGS = 16  # levels of the tree below the root, which come before what is further down
ALL_LEVELS = 1 << 62
MOST_TORN = 50  # steps in a row that leave something behind: then one does not, whatever it takes, so that χ² is known
NARROW = 16.0  # numbers of R a scalar; where there are more, separators may be further off


@part
def substitute(
    graph: Graph, tree: Tree, ids: I64, wildfire_threshold: float, quiet: float, listed: I64, budget: float
) -> None:
    """Solve the new cliques and whatever moves with them.

    changed: gets the variables whose δ changed, each once in a step; S_CHANGED says how many.  lin[2] gets what they
    were.  moved: gets them all since their factors were evaluated last.  listed: scratch, for all cliques.  T_LEFT gets
    the largest square by which a separator that was left alone is off.  wildfire_threshold 0: no separator is left
    alone, nor one that was so below a clique that does not move now.  budget: of the step, see `work`; where it is used
    what was there before stays behind, what is furthest from the root first
    """
    var = graph.var
    clique, lists, numbers, lin = tree.clique, tree.lists, tree.numbers, tree.lin
    scalars, motions = tree.scalars, tree.motions
    state, totals = tree.state, tree.totals
    far, delta, weight = wildfire_threshold * wildfire_threshold, scalars[0], scalars[1]
    motion, shares = take_floats(rg.SIZE, tree.scratch), take_floats(64, tree.scratch)
    if wildfire_threshold == 0.0 and totals[tl.T_LEFT] > 0.0:
        far = -1.0
    motion[rg.LEFT] = 0.0
    body = count = 0
    work, bounded = 0.0, budget < np.inf and state[tl.S_BEHIND] < MOST_TORN
    limit = max(budget - totals[tl.T_WORK], LEAST_SHARE * budget)
    level = take(len(clique) if bounded else 0, tree.scratch)
    for turn in range(2 if bounded else 1):
        deepest = SURROUNDINGS if bounded and turn == 0 else ALL_LEVELS
        for f in range(ids.size - 1, -1, -1):
            if clique[ids[f], tl.C_PARENT] >= 0 or (turn > 0 and clique[ids[f], tl.C_MOVES] & tl.BEHIND == 0):
                continue
            c = ids[f]
            if bounded:
                level[c] = 0
            while c >= 0:
                row = clique[c]
                if turn > 0 and c == ids[f]:
                    row[tl.C_MOVES] &= tl.MOVED
                else:
                    fetch_row(row[tl.C_CHILD], clique)
                    gather_separator(row, var, lists, delta, numbers)
                    fetch_numbers(row[tl.C_CHILD], clique, lists, numbers)
                    if row[tl.C_PIVOTS] > shares.size:
                        shares = np.empty(2 * row[tl.C_PIVOTS])
                    solve_rows(row, numbers, shares)
                    row[tl.C_FIRST] = row[tl.C_MOVES] = 0
                    state[tl.S_SOLVED] += 1
                    work += work_of_solving(row)
                    move_frontals(graph, tree, row, delta, lin[0], lin[2])
                child, above = row[tl.C_CHILD], c
                while True:
                    c = next_clique(graph, tree, child, above, far, delta, weight, motion)
                    if c < 0:
                        break
                    row, child, above = clique[c], clique[c, tl.C_NEXT], clique[c, tl.C_PARENT]
                    if bounded:
                        level[c] = level[above] + 1
                        if row[tl.C_FIRST] != -1 and (work + work_of_solving(row) > limit or level[c] > deepest):
                            rg.leave_behind(above, clique)
                            continue
                    behind = row[tl.C_MOVES] & tl.BEHIND != 0
                    if behind and row[tl.C_FIRST] != -1 and not has_moved(graph, tree, c, far, delta, weight, motion):
                        row[tl.C_MOVES] &= tl.MOVED
                        child, above = row[tl.C_CHILD], c
                        continue
                    if not moves_along(graph, tree, c, far, delta, weight, motion):
                        break
                    # What is in it nobody outside looks at, so it can move later.
                    if body == rg.BODIES:
                        rg.move_bodies(graph, tree, listed[:count], quiet, delta, lin[2], motion)
                        body = count = 0
                    end = count + int((limit - work) / SOLVING) + 1 if bounded else listed.size + 1
                    before = count
                    count = rg.list_subtree(c, body, clique, motions, motion, listed, count, end)
                    work += SOLVING * (count - before)
                    body += 1
                    if behind:
                        rg.leave_behind(above, clique)
        rg.move_bodies(graph, tree, listed[:count], quiet, delta, lin[2], motion)
        body = count = 0
        if work >= limit:
            break
    totals[tl.T_LEFT] = max(totals[tl.T_LEFT] if wildfire_threshold > 0.0 else 0.0, motion[rg.LEFT])
    note_work(work, totals)
    note_behind(ids, clique, state)


@inline_kernel
def note_behind(ids: I64, clique: I64, state: I64) -> None:
    """Whether anything below the roots among `ids` was left behind, or below others."""
    roots, behind = 0, False
    for f in range(ids.size):
        if clique[ids[f], tl.C_PARENT] < 0:
            roots += 1
            behind |= clique[ids[f], tl.C_MOVES] & tl.BEHIND != 0
    if behind or roots == state[tl.S_ROOTS]:
        state[tl.S_BEHIND] = state[tl.S_BEHIND] + 1 if behind else 0


@inline_kernel
def fetch_row(c: int, clique: I64) -> None:
    """The row of clique c, if there is one, comes into the cache."""
    if c >= 0:
        for line in range(0, tl.C_WIDTH, LINE):
            prefetch(clique, c * tl.C_WIDTH + line)


@inline_kernel
def fetch_numbers(c: int, clique: I64, lists: I64, numbers: F64) -> None:
    """The same of what is first read of clique c: its variables, δ of its separator, rows of R."""
    if c >= 0:
        row = clique[c]
        prefetch(lists, row[tl.C_LIST])
        prefetch(numbers, row[tl.C_USED])
        prefetch(numbers, row[tl.C_USED] + LINE)
        prefetch(numbers, row[tl.C_ROWS])
        prefetch(numbers, row[tl.C_ROWS] + row[tl.C_LD])
        prefetch(numbers, row[tl.C_ROWS] + 2 * row[tl.C_LD])


@inline_kernel
def moves_along(graph: Graph, tree: Tree, c: int, far: float, delta: F64, weight: F64, motion: F64) -> bool:
    """Whether a clique and all below it only move as a whole; motion gets by how much."""
    clique = tree.clique
    row = clique[c]
    far = far_of(row, far)
    return (
        row[tl.C_FIRST] != -1
        and row[tl.C_ANCHORED] == 0
        and rg.fit_motion(graph, tree, row, c * tl.M_WIDTH, far, delta, weight, motion)
    )


@inline_kernel
def next_clique(
    graph: Graph, tree: Tree, child: int, above: int, far: float, delta: F64, weight: F64, motion: F64
) -> int:
    """The next clique that has moved, or has one below it that was left behind, from `child` of `above` on, depth
    first; −1: none is left.
    """
    clique = tree.clique
    while True:
        while child >= 0:
            fetch_row(clique[child, tl.C_NEXT], clique)
            if is_visited(graph, tree, child, far, delta, weight, motion):
                return child
            child = clique[child, tl.C_NEXT]
        if clique[above, tl.C_PARENT] < 0:
            return -1
        child, above = clique[above, tl.C_NEXT], clique[above, tl.C_PARENT]


@inline_kernel
def is_visited(graph: Graph, tree: Tree, c: int, far: float, delta: F64, weight: F64, motion: F64) -> bool:
    """Whether a clique is to be solved, or was passed by with the budget used."""
    row = tree.clique[c]
    return (
        row[tl.C_FIRST] == -1
        or row[tl.C_MOVES] & tl.BEHIND != 0
        or has_moved(graph, tree, c, far, delta, weight, motion)
    )


@inline_kernel
def has_moved(graph: Graph, tree: Tree, c: int, far: float, delta: F64, weight: F64, motion: F64) -> bool:
    """Whether a scalar of the separator is further than (9.17) from where the frontals have it, who were solved with
    it and may have moved since.  motion: gets the largest square of what is left
    """
    var = graph.var
    clique, lists, numbers, turns, motions = tree.clique, tree.lists, tree.numbers, tree.turns, tree.motions
    row = clique[c]
    far = far_of(row, far)
    start = row[tl.C_LIST] + row[tl.C_FRONTALS]
    used, moves, left = row[tl.C_USED] + row[tl.C_PIVOTS], row[tl.C_MOVES] & tl.MOVED != 0, 0.0
    for s in range(start, start + row[tl.C_SEPARATORS]):
        v = lists[s]
        d = var[v, at.V_SCALAR]
        if moves:
            rg.displace(v, var, tree.lin[0], turns, motions, c * tl.M_WIDTH, motion)
        for a in range(dim_of_variable(var, v)):
            gap = delta[d + a] - numbers[used]
            if moves:
                gap -= motion[rg.LOCAL + a]
            square = gap * gap * weight[d + a]
            if square > far:
                return True
            left = max(left, square)
            used += 1
    motion[rg.LEFT] = max(motion[rg.LEFT], left)
    return False


@inline_kernel
def far_of(row: I64, far: float) -> float:
    """The square of (9.17) for a clique, `far` being that of one with NARROW numbers of R a scalar."""
    return far * max(1.0, (row[tl.C_SEPARATOR_SCALARS] + 0.5 * row[tl.C_PIVOTS]) / NARROW)


@inline_kernel
def gather_separator(row: I64, var: I64, lists: I64, delta: F64, numbers: F64) -> None:
    """δ_S behind the place of δ_F."""
    start = row[tl.C_LIST] + row[tl.C_FRONTALS]
    x = row[tl.C_USED] + row[tl.C_PIVOTS]
    for s in range(start, start + row[tl.C_SEPARATORS]):
        v = lists[s]
        d = var[v, at.V_SCALAR]
        for a in range(dim_of_variable(var, v)):
            numbers[x] = delta[d + a]
            x += 1


@inline_kernel
def solve_rows(row: I64, numbers: F64, shares: F64) -> None:
    """δ_F = R_F⁻¹ (d − R_S δ_S).  shares: scratch for the pivots.

    The product first, whose rows do not wait for each other, and what each pivot is divided by, since a division takes
    longer than all else that the next one waits for.  Rows are taken by threes: a plane pose has three scalars, and six
    one in space.
    """
    p, used, ld = row[tl.C_PIVOTS], row[tl.C_USED], row[tl.C_LD]
    width = p + row[tl.C_SEPARATOR_SCALARS]
    for i in range(p):
        shares[i] = 1.0 / numbers[row[tl.C_ROWS] + i * (ld + 1)]
    i = 0
    while i + 3 <= p:
        line, x, y, z = row[tl.C_ROWS] + i * ld, 0.0, 0.0, 0.0
        for k in range(p, width):
            known = numbers[used + k]
            x += numbers[line + k] * known
            y += numbers[line + ld + k] * known
            z += numbers[line + 2 * ld + k] * known
        numbers[used + i] = numbers[line + width] - x
        numbers[used + i + 1] = numbers[line + ld + width] - y
        numbers[used + i + 2] = numbers[line + 2 * ld + width] - z
        i += 3
    while i < p:
        line, x = row[tl.C_ROWS] + i * ld, 0.0
        for k in range(p, width):
            x += numbers[line + k] * numbers[used + k]
        numbers[used + i] = numbers[line + width] - x
        i += 1
    while i >= 3:
        i -= 3
        line = row[tl.C_ROWS] + i * ld
        x, y, z = numbers[used + i], numbers[used + i + 1], numbers[used + i + 2]
        for k in range(i + 3, p):
            known = numbers[used + k]
            x -= numbers[line + k] * known
            y -= numbers[line + ld + k] * known
            z -= numbers[line + 2 * ld + k] * known
        z *= shares[i + 2]
        y = (y - numbers[line + ld + i + 2] * z) * shares[i + 1]
        x = (x - numbers[line + i + 2] * z - numbers[line + i + 1] * y) * shares[i]
        numbers[used + i] = x
        numbers[used + i + 1] = y
        numbers[used + i + 2] = z
    while i > 0:
        i -= 1
        line, x = row[tl.C_ROWS] + i * ld, numbers[used + i]
        for k in range(i + 1, p):
            x -= numbers[line + k] * numbers[used + k]
        numbers[used + i] = x * shares[i]


@inline_kernel
def move_frontals(graph: Graph, tree: Tree, row: I64, delta: F64, lin: F64, before: F64) -> None:
    """The estimate of the frontals whose δ is another one."""
    var = graph.var
    node, lists, numbers, moved, state = tree.node, tree.lists, tree.numbers, tree.moved, tree.state
    start, solved = row[tl.C_LIST], row[tl.C_USED]
    for s in range(start, start + row[tl.C_FRONTALS]):
        v = lists[s]
        d, differs = var[v, at.V_SCALAR], False
        for a in range(dim_of_variable(var, v)):
            differs |= numbers[solved] - delta[d + a] != 0.0
            delta[d + a] = numbers[solved]
            solved += 1
        if differs:
            move_variable(graph, tree, v, delta, lin, before)
            note_moved(MODEL, v, node, moved, state)
