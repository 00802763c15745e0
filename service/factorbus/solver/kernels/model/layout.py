"""How the arenas are laid out that every kernel of the nonlinear side reads: column numbers, kind codes, sizes.

The arrays are those of `records.Graph`.
"""

# Columns of `var`.
V_KIND = 0
V_AT = 1  # where its value starts in `values`
V_SCALAR = 2  # where it starts in δ and η; -1: fixed
V_COLUMN = 3  # its block column in Λ; -1: fixed
V_DIAGONAL = 4  # where its diagonal block starts in Λ's data; -1: fixed
V_WIDTH = 5

# Columns of `fac`.
F_KIND = 0
F_I = 1  # first variable
F_J = 2  # second variable; -1: none
F_AT = 3  # where its measurement starts in `payload`
F_II = 4  # where the blocks it adds to start in Λ's data; -1: no such block
F_JJ = 5
F_IJ = 6
F_FLAGS = 7
F_WIDTH = 8

# Bits of F_FLAGS.
SWAPPED = 1  # the block of the pair stands as (j, i), because column j comes first
LOSS_SHIFT = 8  # from here on: the code of its loss

# Entries of `counts`.
VARIABLES = 0
FACTORS = 1
VALUES = 2
PAYLOAD = 3
COLUMNS = 4
SCALARS = 5
STAMPED = 6  # variables that have a time stamp
COUNTS = 7

NO_STAMP = -(2**63)

# Codes of the kinds of variables.
SE2 = 0
SE3 = 1
POINT2 = 2
POINT3 = 3
IDP = 4

# Codes of the kinds of factors.
PRIOR_SE2 = 0
PRIOR_SE3 = 1
PRIOR_POINT2 = 2
PRIOR_POINT3 = 3
BETWEEN_SE2 = 4
BETWEEN_SE3 = 5
LANDMARK_SE2 = 6
LANDMARK_SE3 = 7
BEARING_RANGE_SE2 = 8
IDP_FIRST = 9  # from here on: how far it is bent is computed, (9.11); and these three are what a camera sees
IDP_SEEN = 10
POINT_SEEN = 11
POSITION_SE2 = 12  # from here on: kinds that nobody is placed by
POSITION_SE3 = 13
HEADING_SE2 = 14
ATTITUDE_SE3 = 15
RANGE_SE2 = 16
RANGE_SE3 = 17
BEARING_SE2 = 18
BEARING_SE3 = 19
LINEAR_SE2 = 20  # linear factors of one variable from here on, in the order of the codes of these
LINEAR_SE3 = 21
LINEAR_POINT2 = 22
LINEAR_POINT3 = 23
LINEAR_IDP = 24
LINEAR_PAIR_SE2 = 25  # from here on: of two
LINEAR_PAIR_SE3 = 26
LINEAR_PAIR_POINT2 = 27
LINEAR_PAIR_POINT3 = 28
LINEAR_PAIR_IDP = 29
LINEAR_PAIR_SE2_POINT2 = 30
LINEAR_PAIR_SE3_POINT3 = 31
LINEAR_PAIR_SE3_IDP = 32
LINEAR_PAIR_POINT3_IDP = 33

# Codes of losses.
NO_LOSS = 0
HUBER = 1
CAUCHY = 2
GEMAN_MCCLURE = 3
TUKEY = 4
DCS = 5

# Scratch for a residual: six numbers at most, then what became of a sight (`factorbus.solver.lenses.layout`).
R_STATUS = 6
R_SIZE = 7

# What an admission kernel found wrong with a row.
GOOD = 0
DUPLICATE = 1
OUT_OF_BOUNDS = 2  # NaN, infinite, or not within its bounds (`bounds`)
BAD_QUATERNION = 3
UNKNOWN_FIRST = 4
UNKNOWN_SECOND = 5
WRONG_KIND_FIRST = 6
WRONG_KIND_SECOND = 7
SELF_LOOP = 8
BAD_RANGE = 9
NOT_POSITIVE_DEFINITE = 10
BAD_SCALE = 11
BAD_DIRECTION = 12

# Columns of `groups`: groups of variables and factors whose numbers lie in the bytes of a message, little-endian, one
# row each in any order, and after the last one a row of kind END.  An offset is that of the first byte.
G_KIND = 0
G_FACTORS = 1  # 0: variables, 1: factors
G_COUNT = 2
G_FIXED = 3  # 1: variables that are held where they are
G_ARITY = 4  # keys of a factor; 1 for variables
G_SIZE = 5  # numbers of a value or a measurement
G_TRIANGLE = 6  # numbers of an information matrix; 0 for variables
G_KEYS = 7  # offset of the keys
G_NUMBERS = 8  # offset of the values, -1: they come without; or of the measurements
G_INFORMATION = 9  # offset of the information matrices; -1 for variables
G_STAMPS = 10  # offset of the time stamps; -1: they have none, and factors have none
G_WIDTH = 11

# What `admit_bytes` gives beside the number of the first factor.
NOT_IN_ORDER = -1
NO_ROOM = -2
END = -1
