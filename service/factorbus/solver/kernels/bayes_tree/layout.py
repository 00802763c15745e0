"""The tree of cliques: what its records hold and where its numbers lie.  MATH §9.

A clique is a set of variables eliminated together (its frontals, F) given those they still depend on (its separator,
S).  It keeps its rows of R, with d as the last column, and its update matrix U: what eliminating its subtree leaves on
S, with a last column for the right-hand side and a corner for χ²,

    rows   p × (p + m + 1):   [ R_F  R_S  d ]           U   (m + 1) × (m + 1):   [ Λ'_S  η'_S ; ·  χ²' ]

p and m count scalars.  Its variables, frontals first, are `lists[LIST :]`; columns follow that order.

Its arrays are those of `records.Tree`; what their columns hold stands here.
"""

# Columns of `node`, a cache line each: what most steps look at,
N_CLIQUE = 0  # where it is a frontal; -1: nowhere yet, or fixed
N_PLACE = 1  # its index in that clique's list
N_STAMP = 2  # the last elimination it took part in
N_LOCAL = 3  # its index there
N_ADJ = 4  # first incidence, 2 · factor + end; -1: none
N_MOVED = 5  # the last step that changed its estimate
N_LISTED = 6  # not 0: it is in `moved`, see `move_estimate`
N_FLAGS = 7  # 1: waits to be relinearized; 2: is being
# and the rest.
N_OWN = 8  # first factor that is added where this variable is eliminated; -1: none
N_SEEN = 9  # the last step that brought a factor of it
N_COLUMN = 10  # scratch: its column in the clique at hand
N_LINEARIZED = 11  # the last step that gave it a linearization point
N_NEAR = 12  # the last elimination that looked whether to bring it near the root,
N_RING = 13  # and the ring in which it did so; 0: the outermost; −1: it did not
N_WIDTH = 16

# Columns of `factor_errors`, a cache line of what every evaluation looks at: d, √ω, |Ω r| or what (9.13) is by shift
# and |r|, the form; at the estimate χ², error² in full, what a chord step leaves of it, and
# error² as it counts.
E_LEVER, E_ROOT, E_SHIFT, E_FORM, E_CHI2, E_ERROR, E_LEAVES, E_COUNTED = range(8)
# And one of the rest: ω_θ; what (9.33) and (9.34) were where a chord step corrected the model, 6 numbers.
E_TURN, E_MISSED, E_WIDTH = 8, 9, 16
# In E_FORM: Ω of a translation is isotropic and not coupled to the angle; a chord step has corrected the linear model;
# or, alone: it is of an IMU's samples, without a loss, and its Ω is one.
ISOTROPIC, CORRECTED, PLAIN_SAMPLES = 1.0, 2.0, 4.0

# Columns of `turns`.
U_LEVER, U_COS, U_SIN, U_WIDTH = 0, 1, 2, 4

# Columns of `link`.
L_OWN = 0  # next factor added at the same variable
L_I = 1  # next incidence of the first variable
L_J = 2  # next incidence of the second one
L_AT = 3  # where its Hessian starts
L_STAMP = 4  # the last sweep that linearized it
L_KIND = 5  # as in the graph, so that one cache line has all; or EXACT or INACTIVE
L_WIDTH = 8  # a cache line

# In L_KIND: the linearization error of an observation, or of a factor with a loss, is computed (9.11); an inactive
# observation.
EXACT, INACTIVE = 1000, 1001

# Columns of `clique`, a cache line each: what back-substitution reads of a clique,
C_LIST = 0
C_FRONTALS = 1  # variables
C_SEPARATORS = 2  # variables
C_PIVOTS = 3  # p
C_USED = 4  # where δ_F and δ_S are as the frontals were solved last, p + m doubles
C_CHILD = 5
C_NEXT = 6  # next child of the same parent; next free record
C_PARENT = 7  # -1: a root
# what it reads of one that has moved,
C_FIRST = 8  # the first place touched by the elimination C_MARK; -1: not solved yet
C_ANCHORED = 9  # 1: a factor in it or below says where in the world its variables are
C_MOVES = 10  # the sum of MOVED and BEHIND
C_SEPARATOR_SCALARS = 11  # m
C_ROWS = 12  # column j of row i of R is at ROWS + i · LD + j
C_LD = 13
C_UPDATE = 14  # column j of row i of U is at UPDATE + update_row(i, WIDTH_UPDATE) + j, see `fronts`
C_WIDTH_UPDATE = 15
# and the rest.
C_ABOVE = 16  # place in the parent's list of the first separator variable to be eliminated
C_MARK = 17  # the last elimination that touched it
C_BLOCK = 18  # the block that holds the rows and what is at USED, and its size
C_BLOCK_SIZE = 19
C_UPDATE_BLOCK_SIZE = 20
C_LIST_SIZE = 21
C_WIDTH = 24

# In C_MOVES: it has moved as a whole since it was solved; one below it was left behind where a step's budget was used.
MOVED, BEHIND = 1, 2

# Entries of `motions`, by clique.
M_SINCE = 0  # ξ since it was solved, (9.20), MOTION numbers: t, ω
M_BODY = 6  # scratch: the body it moves with,
M_TURN = 7  # and the angle that it has turned by since it was solved
MOTION, M_WIDTH = 6, 8

# Entries of `state`.
S_STAMP = 0  # of the present elimination
S_STEP = 1
S_CLIQUES = 2  # records ever used
S_FREE_CLIQUE = 3  # first free record; -1: none
S_LISTS = 4  # end of `lists` in use
S_NUMBERS = 5  # end of `numbers` in use
S_HESSIAN = 6
S_VARIABLES = 7  # of the graph, added
S_FACTORS = 8
S_PENDING = 9  # variables that wait to be relinearized
S_ALIVE = 10  # cliques
S_NEED_CLIQUES = 11  # what the last call lacked
S_NEED_LISTS = 12
S_NEED_NUMBERS = 13
S_FAILED = 14  # variable whose pivot failed, or -1
# The report of the last step, from S_REPORT_BEGIN to before S_REPORT_END.
S_REPORT_BEGIN = 15
S_NONZEROS = 15  # of R, doubles of rows on and above the diagonal
S_INACTIVE = 16  # observations that had no pixel where they were linearized
S_DIFFERING = 17  # variables whose estimate has other bits than before the step, new ones included
S_ELIMINATED = 18  # variables eliminated,
S_RELINEARIZED = 19  # linearization points moved,
S_SOLVED = 20  # cliques solved again
S_CHANGED = 21  # variables whose estimate changed
S_FLOPS = 22
S_ROUNDS = 23  # eliminations
S_CYCLES = 24  # of the phases, PHASES of them
S_REPORT_END = 31
S_TAKEN = 31  # factors that are in the tree: S_FACTORS but for those of a step under way
S_SWEEP = 32  # counts relinearizations
S_FIRST_NEW = 33  # variables that are in the tree: S_VARIABLES but for those of a step under way
S_WAIT = 34  # 1: the step under way relinearizes nothing, because that failed
S_MOVED = 35  # variables in `moved`
S_ROOTS = 36
S_BEGUN = 37  # 1: a step is under way; the arenas lacked room
S_CHECKED = 38  # 1: that everything is held has been made sure of otherwise
S_CHANGED_BEFORE = 39  # S_CHANGED of the step before, for when this one fails
S_EXACT = 40  # factors whose linearization error is computed
S_WAITING = 41  # the step since when any variable waits to be relinearized
S_DUE = 42  # 1: what waits is relinearized in the next step
S_OLD = 43  # variables before the step
S_MOVING_ROOT = 44  # flops of the last elimination that brought variables near the root,
S_SPENT = 45  # and of all others since
S_RELINEARIZED_AT = 46  # the step that relinearized last
S_CONTINUES = 47  # 1: the step under way has nothing new
S_IDLE = 48  # doubles of free blocks of `numbers`,
S_GIVEN = 49  # of those freed since they were joined,
S_LARGEST = 50  # and no class above this one has any
S_RELINEARIZING = 51  # flops of the last elimination that relinearized
S_RISES = 52  # 1: the last round of the step raised χ²
S_ONCE = 53  # 1: the step under way has one round
S_RAISED = 54  # RAISED_PIVOT: one was raised, so that R is not quite that of Λ; or DAMPED: all are damped for that
S_AFTER = 55  # why more than the step is to be done: sums of WORSE, ROSE, RAISED; 0: nothing
S_EDITED = 56  # variables in `moved` whose factors were edited since the last step; they come first
S_EDITED_AT = 57  # the last step that such factors went before
S_HOLES = 58  # doubles of `hessian` that no factor has any more
S_CHORDS = 59  # chord steps of the step
S_SLOW = 60  # 1: the last step had not converged after its rounds
S_BEHIND = 61  # how many back-substitutions in a row left something behind, as the budget was used
S_TRY_AT = 62  # before this step no relinearization is looked for: none fitted into the budget
S_WAS_BEHIND = 63  # S_BEHIND before the step
S_FREE = 64  # heads of free lists: numbers, then lists
CLASSES = 256
S_SIZE = S_FREE + 2 * CLASSES

# What a step comes to.  CLEAR: it is done, has converged, and nothing has to be looked at again.
DONE, NO_ROOM, FAILED, UNSURE, INFINITE, CLEAR = 0, 1, 2, 3, 4, 5

# In S_RAISED.
RAISED_PIVOT, DAMPED = 1, 2

# In S_AFTER: the step raised χ², or its last round did, or a pivot was raised.
WORSE, ROSE, RAISED = 1, 2, 4

# Settings of a step.
P_WILDFIRE_THRESHOLD = 0  # in units of (9.17): how far a separator moves before its clique is solved again
P_RELINEARIZE_THRESHOLD = 1  # a variable with a linearization error of more than this waits to be relinearized
P_SAME_STEP_SHARE = 2  # what waits is relinearized in the same step where all errors add more than this share to χ²
P_SPLIT_MIN_PIVOTS = 3  # larger cliques, in pivot scalars,
P_SPLIT_MAX_AFFECTED = 4  # of which no more than this share is touched, keep their leading frontals
P_CONVERGED = (
    5  # a step goes on while a Gauss–Newton step may lower χ² by more than this share; one that raised it so ends
)
P_CHI2_EPSILON = 6  # a χ² that is nothing
P_RECENT_STEPS = 7  # variables with a factor in this number of last steps are eliminated last
P_MAX_ROUNDS = 8  # eliminations in a step, at most
P_INITIALIZE = 9  # how many new variables, at most, are first put where their own factors want them
P_NEXT_STEP_SHARE = 10  # what waits is relinearized in the next step where all errors add more than this share,
P_MAX_WAIT = 11  # or where any has waited for this number of steps,
P_MAX_ERROR = 12  # or the error of one factor is more than this
P_REROOT_MIN_FLOPS = 13  # an elimination of more flops brings what is near to the root,
P_REROOT_PERIOD = 14  # when with it this share has been spent of what that took the last time
P_REROOT_SIZE_LINEAR = 15  # size of the part near the root, in scalars: times the cube root of the flops
P_COOLDOWN_STEPS = 16  # steps after a relinearization in which P_NEXT_STEP_SHARE and P_SAME_STEP_SHARE are more,
P_COOLDOWN_FACTOR = 17  # up to this factor
P_FULL_BATCH = 18  # P_NEXT_STEP_SHARE and P_SAME_STEP_SHARE are for this number of scalars that wait, (9.22)
P_COOLDOWN_FLOPS = 19  # P_COOLDOWN_STEPS is for a relinearization of this number of flops
P_REROOT_SIZE_AREA = 20  # or times its square, if that is more,
P_REROOT_RING_RATIO = 21  # in rings, each with all inside it this many times as large as the next one,
P_REROOT_MAX_EXTRA = 22  # unless that takes more than this share of the elimination in addition
P_BUDGET = 23  # what a step may take, in the units of `work`
P_SIZE = 24

# The phases of a step, in the order of `step`.
PHASES = ("linearize", "mark", "order", "symbolic", "eliminate", "commit", "substitute")
LINEARIZE, MARK, ORDER, SYMBOLIC, ELIMINATE, COMMIT, SUBSTITUTE = range(7)

# Entries of `totals`.
T_MODEL = 0  # χ² of the linear problem at its solution
T_CHI2 = 1  # χ² at the estimate
T_CONSTANT = 2  # in T_MODEL: χ² of factors between fixed variables
T_ERROR = 3  # Σ error² of all factors, which bounds what a Gauss–Newton step would take off χ²
T_ALLOWED = 4  # the Σ error² up to which the last step has converged, (9.32)
T_BEFORE = 5  # χ² at the estimate before the step, new factors and first values of new variables included
T_ADDED = 6  # of that: of the new factors
T_LEFT = 7  # by how much back-substitution left something undone, σ², the largest of all scalars
T_ADDED_UP = 8  # what T_CHI2 and T_ERROR have gained and lost since they were summed
T_COUNTED = 9  # Σ error² as it counts for what is relinearized
T_LARGEST_DIAGONAL = 10  # the largest sum of the diagonals of Hessians of any scalar,
T_LARGEST_DIAGONAL_BEFORE = 11  # and before the step
T_LEAST = 12  # what the optimum's χ² cannot be below, (9.29)
T_GAINED = 13  # by how much a round of the last step lowered χ², or all of it, at most
T_UNIT = 14  # (9.6), as it was before the step
T_WORK = 15  # what the step has taken so far, in the units of `work`
T_WHOLE = 16  # χ² when last nothing was behind, nor worse than it had been, and of the factors that came since
T_ERROR_BEFORE = 17  # T_ERROR before the step
T_UNCHECKED = 18  # by how much error² of factors has changed, all in all, since the decrement was computed,
T_CHECKED = 19  # and T_ERROR as it was then
T_EXCESS = 20  # by how much the decrement was more than that, (9.40), where it was too much
T_COST_RATIO = 21  # r of (9.19), as it was when the step began,
T_COOLDOWN = 22  # and (9.19)
T_SIZE = 23
