"""What the next Gauss-Newton step would take off χ²: the gradient at the estimate, by R.  MATH (9.39), (9.40)

Σ error² adds up what each factor misses by itself.  Forces of many factors add up along directions that the map hardly
holds, as where their Jacobians have turned alike, or where only several cameras together say how far away something is,
and the step takes off more than that sum.  So where the sum is not nothing the forces are added up by variable first:

1  gradient    of the factors with a part in Σ error²: at the estimate, less that of their linear models
2  forwards    d = R⁻ᵀ g in the cliques of their variables and those above, children first: |d|² is the decrement
3  backwards   z = R⁻¹ d where that is too much, parents first, and along it what χ² loses: R may be old, and then that
               is less, or the step is elsewhere.  So 2 and 3 are repeated with the gradient that is left, each
               direction conjugate to those before: conjugate gradients, preconditioned by R
4  try         the step, where what it takes off is not little: along a curved valley χ² falls by up to twice as much,
               and further steps gain hardly less
"""

import numpy as np

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.affected import dim_of_variable
from factorbus.solver.kernels.bayes_tree.hessian_room import kept_samples, last_of_hessian
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.bayes_tree.refactor_in_place import mark_above
from factorbus.solver.kernels.bayes_tree.work import RELINEARIZING, SCANNING, note_work, work_of_solving
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.chi2 import sum_chi2
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, is_member, is_one_of_many, row_of_pair
from factorbus.solver.kernels.model.linearize import Scratch, make_scratch
from factorbus.solver.kernels.model.multiply_hessian import add_product, add_product_of_many
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.retract import move

TRIED = 0.02  # of what may be left: a step that is to take off more is tried
HARDLY_LESS = 0.5  # of what the step before gained: one that gains more follows a valley
AMPLE = 2.0  # times what steps that converge at one rate come to
DIRECTIONS = 6  # at most: on old R the first are along what R, and not Λ, hardly holds


@part
def decrement(least: float, whole: bool, most: float, graph: Graph, tree: Tree) -> float:
    """|R⁻ᵀ g|² with g the gradient that the linear models of factors miss, of error² above `least`, and, with `whole`,
    of those that are absolute; where that is more than `most`, what χ² loses by the best step in up to `DIRECTIONS`
    directions, by the Jacobians at the estimate, or in as many as come to more than `most`.  Where that is within
    `most` and not little, with `whole`: what steps like it take off one after the other.
    """
    var, fac, node, clique, state = graph.var, graph.fac, tree.node, tree.clique, tree.state
    g = np.zeros(graph.counts[at.SCALARS])
    scratch, end, taken = make_scratch(), tree.marked.size, 0
    state[tl.S_STAMP] += 1
    # 1
    for f in range(state[tl.S_FACTORS]):
        if has_part(f, least, whole, graph, tree):
            taken += 1
            add_difference(graph, tree, f, scratch, tree.scalars[0], True, g)
            for n in range(count_ends(f, fac)):
                v = end_of(f, n, fac)
                if var[v, at.V_SCALAR] >= 0:
                    end = mark_above(v, node, clique, state, tree.marked, end)
    cliques, work = tree.marked[end:], 0.0
    for k in range(cliques.size):
        work += work_of_solving(clique[cliques[k]])
    work += SCANNING * state[tl.S_FACTORS] + RELINEARIZING * taken
    note_work(work, tree.totals)
    # 2
    z = g.copy()
    square = solve_forwards(graph, tree, cliques, z)
    if square <= most:
        if square <= TRIED * most or not whole:
            return square
        solve_backwards(graph, tree, cliques, z)
        return left_along(z, square, graph, tree)
    # 3  p: the direction; Mp: RᵀR p; Ap: Λ p at the estimate
    found, p, Mp, step = 0.0, np.zeros(g.size), np.zeros(g.size), np.zeros(g.size)
    factor = 0.0
    for _ in range(DIRECTIONS):
        solve_backwards(graph, tree, cliques, z)
        Ap = np.zeros(g.size)
        for s in range(g.size):
            p[s] = z[s] + factor * p[s]
            Mp[s] = g[s] + factor * Mp[s]
        for f in range(state[tl.S_FACTORS]):
            if has_part(f, least, whole, graph, tree):
                add_difference(graph, tree, f, scratch, p, False, Ap)
        note_work(work, tree.totals)
        curvature = 0.0
        for s in range(g.size):
            Ap[s] += Mp[s]
            curvature += p[s] * Ap[s]
        if not curvature > 0.0:
            return square
        found += square * (square / curvature)
        if found > most:
            return found
        for s in range(g.size):
            step[s] += square / curvature * p[s]
            g[s] -= square / curvature * Ap[s]
            z[s] = g[s]
        before, square = square, solve_forwards(graph, tree, cliques, z)
        factor = square / before
    return left_along(step, found, graph, tree) if found > TRIED * most and whole else found


@inline_kernel
def has_part(f: int, least: float, whole: bool, graph: Graph, tree: Tree) -> bool:
    """Whether the gradient of factor f is another one than that of its linear model: error² of more than `least`, or,
    with `whole`, the map may have turned against what is fixed, and the force of what is exactly linear with it."""
    if is_member(f, graph.fac):
        return False
    i, j = graph.fac[f, at.F_I], graph.fac[f, at.F_J]
    if tree.factor_errors[f, tl.E_ERROR] > least or not whole:
        return tree.factor_errors[f, tl.E_ERROR] > least
    return j < 0 or graph.var[i, at.V_SCALAR] < 0 or graph.var[j, at.V_SCALAR] < 0


@part
def left_along(step: F64, expected: float, graph: Graph, tree: Tree) -> float:
    """What steps take off χ² of which the first, −`step`, is `expected` to take off so much.  (9.41)

    χ² falls by (1 + r) times as much, r the rate at which Gauss-Newton steps converge along it: Λ leaves out what
    curves χ² the other way.  So they come to 1 / (1 − r) times as much.  From `HARDLY_LESS` on nobody knows to how
    much, for along a valley r is not the same for long; nor where χ² falls by so much less: what follows then goes
    elsewhere, and may gain more.
    """
    variables, factors = tree.state[tl.S_VARIABLES], tree.state[tl.S_FACTORS]
    for s in range(step.size):
        step[s] = -step[s]
    there = np.empty(graph.counts[at.VALUES])
    move(variables, graph.var, graph.values, step, there)
    chi2 = tree.totals[tl.T_CHI2]
    note_work(RELINEARIZING * factors, tree.totals)
    rate = (chi2 - sum_chi2(0, factors, graph.var, graph.fac, there, graph.payload)) / expected - 1.0
    if not -HARDLY_LESS < rate < HARDLY_LESS:
        return chi2
    return min(AMPLE * expected / (1.0 - rate) if rate > 0.0 else expected, chi2)


@part
def add_difference(graph: Graph, tree: Tree, f: int, scratch: Scratch, x: F64, gradient: bool, out: F64) -> None:
    """out += J'ᵀ Ω r' − (H δ − η) of factor f with x = δ, its gradient at the estimate less that of its linear model;
    or out += J'ᵀ Ω J' x − H x.
    """
    if is_one_of_many(f, graph.fac):
        add_difference_of_many(graph, tree, f, x, gradient, out)
        return
    add_product(f, graph, scratch, x, gradient, out)
    subtract_model(graph, tree, f, x, gradient, out)


@part
def add_difference_of_many(graph: Graph, tree: Tree, f: int, x: F64, gradient: bool, out: F64) -> None:
    """The same of a factor that `many` evaluates."""
    ends = count_ends(f, graph.fac)
    add_product_of_many(f, graph, kept_samples(f, graph.var, graph.fac, tree), x, gradient, out)
    for n in range(max(ends - 1, 1)):
        for m in range(n + 1, max(ends, 2)):
            subtract_model(graph, tree, row_of_pair(f, n, m, ends), x, gradient, out)


@part
def subtract_model(graph: Graph, tree: Tree, row: int, x: F64, gradient: bool, out: F64) -> None:
    """out −= H x of the Hessian of a row, or H x − η."""
    var, fac, hessian = graph.var, graph.fac, tree.hessian
    i, j = fac[row, at.F_I], fac[row, at.F_J]
    di = dim_of_variable(var, i)
    dj = dim_of_variable(var, j) if j >= 0 else 0
    s, t = var[i, at.V_SCALAR], var[j, at.V_SCALAR] if j >= 0 else -1
    h, eta = tree.link[row, tl.L_AT], last_of_hessian(row, var, fac, tree.link) - di - dj
    across, second, sign = h + di * di, h + di * di + di * dj, 1.0 if gradient else 0.0
    for a in range(di if s >= 0 else 0):
        total = -sign * hessian[eta + a]
        for b in range(di):
            total += hessian[h + a * di + b] * x[s + b]
        for b in range(dj if t >= 0 else 0):
            total += hessian[across + a * dj + b] * x[t + b]
        out[s + a] -= total
    for b in range(dj if t >= 0 else 0):
        total = -sign * hessian[eta + di + b]
        for a in range(di if s >= 0 else 0):
            total += hessian[across + a * dj + b] * x[s + a]
        for a in range(dj):
            total += hessian[second + b * dj + a] * x[t + a]
        out[t + b] -= total


@part
def solve_forwards(graph: Graph, tree: Tree, cliques: I64, g: F64) -> float:
    """d = R⁻ᵀ g over `cliques`, children first, in the place of g; gives |d|²."""
    clique, numbers, square = tree.clique, tree.numbers, 0.0
    eta = np.empty(widest_of(cliques, clique))
    for k in range(cliques.size):
        row = clique[cliques[k]]
        gather(row, graph.var, tree.lists, g, eta)
        p, width, ld = row[tl.C_PIVOTS], row[tl.C_PIVOTS] + row[tl.C_SEPARATOR_SCALARS], row[tl.C_LD]
        for i in range(p):
            line = row[tl.C_ROWS] + i * ld
            d = eta[i] / numbers[line + i]
            square += d * d
            eta[i] = d
            for c in range(i + 1, width):
                eta[c] -= numbers[line + c] * d
        scatter(row, graph.var, tree.lists, eta, g)
    return square


@part
def solve_backwards(graph: Graph, tree: Tree, cliques: I64, d: F64) -> None:
    """p = R⁻¹ d over `cliques`, which come children first, in the place of d."""
    clique, numbers = tree.clique, tree.numbers
    x = np.empty(widest_of(cliques, clique))
    for k in range(cliques.size - 1, -1, -1):
        row = clique[cliques[k]]
        gather(row, graph.var, tree.lists, d, x)
        p, width, ld = row[tl.C_PIVOTS], row[tl.C_PIVOTS] + row[tl.C_SEPARATOR_SCALARS], row[tl.C_LD]
        for i in range(p - 1, -1, -1):
            line = row[tl.C_ROWS] + i * ld
            total = x[i]
            for c in range(i + 1, width):
                total -= numbers[line + c] * x[c]
            x[i] = total / numbers[line + i]
        scatter(row, graph.var, tree.lists, x, d)


@inline_kernel
def widest_of(cliques: I64, clique: I64) -> int:
    """The most scalars that one of these cliques has."""
    widest = 0
    for k in range(cliques.size):
        widest = max(widest, clique[cliques[k], tl.C_PIVOTS] + clique[cliques[k], tl.C_SEPARATOR_SCALARS])
    return widest


@inline_kernel
def gather(row: I64, var: I64, lists: I64, g: F64, eta: F64) -> None:
    """eta = g of the variables of a clique, by its columns."""
    x = 0
    for k in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS] + row[tl.C_SEPARATORS]):
        s = var[lists[k], at.V_SCALAR]
        for a in range(dim_of_variable(var, lists[k])):
            eta[x] = g[s + a]
            x += 1


@inline_kernel
def scatter(row: I64, var: I64, lists: I64, eta: F64, g: F64) -> None:
    """g of the variables of a clique = eta."""
    x = 0
    for k in range(row[tl.C_LIST], row[tl.C_LIST] + row[tl.C_FRONTALS] + row[tl.C_SEPARATORS]):
        s = var[lists[k], at.V_SCALAR]
        for a in range(dim_of_variable(var, lists[k])):
            g[s + a] = eta[x]
            x += 1
