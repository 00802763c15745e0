"""The tree of cliques and a step of it as kernels see them: arrays by name."""

from typing import Annotated, NamedTuple

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.jit.records import FloatRows, Floats, IntRows, Ints, RowWidth, opener


class Tree(NamedTuple):
    """The arrays of a tree, each from the start of a cache line on; `layout` has their columns and entries.

    settings (24,) float64   thresholds of a step, see P_WILDFIRE_THRESHOLD and so on
    node    (n, 16) int64    one row per variable, by its index in the graph
    link    (m, 8) int64     one row per factor, by its id
    clique  (c, 24) int64    one row per clique
    lists   int64            variables of cliques
    numbers float64          rows of R and update matrices; the first `fronts.SCRATCH` doubles are scratch
    hessian float64          of each factor: HᵢᵀΩHᵢ, HᵢᵀΩHⱼ, HⱼᵀΩHⱼ, −HᵢᵀΩr, −HⱼᵀΩr, rᵀΩr where it was linearized
    lin     (3, x) float64   laid out as the graph's values: linearization points; those to go back to; the estimate
                             before the step, of what it changes
    scalars (3, s) float64   δ; the sum of the diagonals of the factors' Hessians, which measures δ in sigmas; δ to go
                             back to while variables are relinearized
    factor_errors (m, 16) float64  of each factor d and √ω, (9.4); of a landmark |Ω r| where it was linearized, (9.12);
                             between poses ω_θ, and what (9.13) is by |r| and the shift; whether its Ω is isotropic for
                             the translation; at the estimate χ², error² in full, and as it counts; what a chord step
                             has corrected its model by
    turns   (n, 4) float64   of each variable: the largest d √ω of what it sees; cosine and sine where a plane pose is
                             linearized
    pending, changed, moved  (n,) int64   variables: that wait to be relinearized; that the step changed; that moved
                             since their factors were evaluated last
    marked  (c,) int64       scratch: cliques that an elimination touches, later those that move as a whole
    motions (8 c,) float64   of each clique how it has moved as a whole since it was solved
    saved   (2 k, SAVED) float64 what the k factors of a step under way change of their variables, for when it fails
    state   int64            counters and the heads of free lists
    totals  (21,) float64    χ² and sums of errors over all factors, and bounds that follow from them
    scratch int64            room for short arrays, see `jit/scratch.py`
    """

    settings: Floats
    node: Annotated[IntRows, RowWidth(tl.N_WIDTH)]
    link: Annotated[IntRows, RowWidth(tl.L_WIDTH)]
    clique: Annotated[IntRows, RowWidth(tl.C_WIDTH)]
    lists: Ints
    numbers: Floats
    hessian: Floats
    lin: FloatRows
    scalars: FloatRows
    factor_errors: Annotated[FloatRows, RowWidth(tl.E_WIDTH)]
    turns: Annotated[FloatRows, RowWidth(tl.U_WIDTH)]
    pending: Ints
    changed: Ints
    moved: Ints
    marked: Ints
    motions: Floats
    saved: FloatRows
    state: Ints
    totals: Floats
    scratch: Ints


class Affected(NamedTuple):
    """What an elimination takes apart.

    cliques    those that it touches   orphans   the cliques that hang from these and stay as they are
    variables  those to be eliminated again, by their local numbers
    factors    those that are added to the new fronts
    """

    cliques: I64
    orphans: I64
    variables: I64
    factors: I64


class Fronts(NamedTuple):
    """The order in which affected variables are eliminated, and the fronts that follow from it.

    order (n,)   local numbers in the order of elimination;  place (n,): its inverse
    home  (n,)   the front where the variable at a place is a pivot
    records      one row per front, as `fronts` has it
    separator_at, separator_of   the separator of front f is separator_of[separator_at[f] : separator_at[f + 1]]; places
    """

    order: I64
    place: I64
    home: I64
    records: I64
    separator_at: I64
    separator_of: I64


tree_at = opener(Tree)
