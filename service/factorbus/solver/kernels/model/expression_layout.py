"""How an own kind lies in a factor's payload, before its measurement: a head, constants, and instructions.  MATH §3.11.

An instruction is about values, which are known by where they begin among all values (v), and by the first row of their
tangents (T): what they change by for each scalar of the variables.  First among the values are the variables, then what
is measured, then the constants.  Three numbers hold the fields of an instruction, as an integer below 2⁵³ each.
"""

# The head.
X_BEFORE = 0  # numbers before the information: of all this, and of what is measured
X_LENGTH = 1  # numbers of this alone
X_ID = 2  # of the kind
X_INSTRUCTIONS, X_CONSTANTS = 3, 4  # how many
X_VALUES, X_ROWS = 5, 6  # sizes of v and T
X_RESIDUAL, X_RESIDUAL_ROW = 7, 8  # where the residual is
X_QUATERNION = 9  # where in the measurement a quaternion begins; −1: nowhere
X_RIGID = 10  # 1: of two variables, and the residual stays as both move as one body
HEAD = 11

# Fields: what to do, for how many numbers; of which scalars of the variables the result is a function; the result's
# value and row, and those of its arguments.
OP, N, FIRST, LAST, OUT, ROW, A, A_ROW, B, B_ROW = range(10)
FIELDS = 10
WORDS = 3
# Their bits, and in which of the three numbers each is.
OP_BITS, N_BITS, SCALAR_BITS, PLACE_BITS = 6, 7, 8, 16

_OPERATIONS = (
    *("compose_so3", "compose_se2", "compose_se3", "inverse_so3", "inverse_se2", "inverse_se3"),
    *("rotate_so3", "rotate_se2", "act_se2", "act_se3", "position", "pose_se2", "pose_se3", "log", "exp"),
    *("vector_part", "norm", "dot", "cross3", "cross2", "atan2", "sqrt", "sin", "cos", "wrap", "copy"),
    *("copy_where", "add", "subtract", "negate", "multiply", "scale", "divide"),
)
CODES = {name: code for code, name in enumerate(_OPERATIONS)}
