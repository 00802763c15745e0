"""How the arenas are laid out that every kernel of the nonlinear side reads: column numbers, kind codes, sizes.

The arrays are those of `records.Graph`.
"""

from factorbus.proto.kinds import FACTOR_KINDS, LOSSES, VARIABLE_KINDS

# Columns of `var`.
V_KIND = 0
V_AT = 1  # where its value starts in `values`
V_SCALAR = 2  # where it starts in δ and η; -1: fixed
V_COLUMN = 3  # its block column in Λ; -1: fixed
V_DIAGONAL = 4  # where its diagonal block starts in Λ's data; -1: fixed
V_WIDTH = 5

# Columns of `fac`: a row for a factor of one or two variables, and for one of more a row for each pair of them, one
# behind the other (`factor_rows`).  The first is the factor's, the others are its members.
F_KIND = 0  # MEMBER: a further pair of the factor that begins before it
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
RIGID = 2  # of an own kind: of a pose and what it sees, and its residual stays as both move as one body
MOUNTED = 4  # of an inertial factor: the mount is a variable, the first behind the six that all of them have
LOSS_SHIFT, LOSS_MASK = 8, 0xFF  # the code of its loss
OFFSET_SHIFT, OFFSET_MASK = 16, 0xFFFF  # of a member: how many rows before it the factor begins
ENDS_SHIFT, ENDS_MASK = 32, 0xFF  # of a factor of any number of variables (`many`): how many; of others 0
SAMPLES_SHIFT, SAMPLES_MASK = 40, 0x7FF  # of an inertial factor: how many samples; 0: none
DIM_SHIFT = 51  # of a factor that `many` evaluates: how many numbers its residual has

# Entries of `counts`.
VARIABLES = 0
FACTORS = 1
VALUES = 2
PAYLOAD = 3
COLUMNS = 4
SCALARS = 5
STAMPED = 6  # variables that have a time stamp
MEMBERS = 7  # rows of `fac` that are not the first of their factor
COUNTS = 8

NO_STAMP = -(2**63)

# Codes of the kinds of variables and factors: their places in the wire's tables, whose order means nothing.  Named
# here are kinds that the solver has code of its own for; what it has to know of any kind is in `kinds` and `sizes`.
VARIABLE_CODES = {name: code for code, name in enumerate(VARIABLE_KINDS)}
FACTOR_CODES = {name: code for code, name in enumerate(FACTOR_KINDS)}
SE2 = VARIABLE_CODES["se2"]
SE3 = VARIABLE_CODES["se3"]
POINT2 = VARIABLE_CODES["point2"]
POINT3 = VARIABLE_CODES["point3"]
IDP = VARIABLE_CODES["idp"]
SO3 = VARIABLE_CODES["so3"]
SIM3 = VARIABLE_CODES["sim3"]

# The kind of all linear factors, whose rows and variables are their own.
LINEAR = len(FACTOR_KINDS)
# In place of a kind: the row is of a pair of a factor that begins before it.
MEMBER = LINEAR + 1
# The kind of all factors of kinds that clients wrote themselves (`expression_layout`).
OWN = MEMBER + 1
# The kind of all inertial factors with samples, whose number is their own, and that of those integrated already.
IMU = OWN + 1
PREINTEGRATED = IMU + 1
# How many codes there are behind those of the wire's table.
FURTHER_CODES = PREINTEGRATED + 1 - LINEAR

PRIOR_SE2 = FACTOR_CODES["prior_se2"]
PRIOR_SE3 = FACTOR_CODES["prior_se3"]
PRIOR_POINT2 = FACTOR_CODES["prior_point2"]
PRIOR_POINT3 = FACTOR_CODES["prior_point3"]
BETWEEN_SE2 = FACTOR_CODES["between_se2"]
BETWEEN_SE3 = FACTOR_CODES["between_se3"]
LANDMARK_SE2 = FACTOR_CODES["landmark_se2"]
LANDMARK_SE3 = FACTOR_CODES["landmark_se3"]
BEARING_RANGE_SE2 = FACTOR_CODES["bearing_range_se2"]
IDP_FIRST = FACTOR_CODES["idp_first"]
IDP_SEEN = FACTOR_CODES["idp_seen"]
POINT_SEEN = FACTOR_CODES["point_seen"]
POSITION_SE2 = FACTOR_CODES["position_se2"]
POSITION_SE3 = FACTOR_CODES["position_se3"]
HEADING_SE2 = FACTOR_CODES["heading_se2"]
ATTITUDE_SE3 = FACTOR_CODES["attitude_se3"]
BEARING_SE2 = FACTOR_CODES["bearing_se2"]
BEARING_SE3 = FACTOR_CODES["bearing_se3"]
PRIOR_SO3 = FACTOR_CODES["prior_so3"]
BETWEEN_SO3 = FACTOR_CODES["between_so3"]
ATTITUDE_SO3 = FACTOR_CODES["attitude_so3"]
PRIOR_SIM3 = FACTOR_CODES["prior_sim3"]
BETWEEN_SIM3 = FACTOR_CODES["between_sim3"]
LANDMARK_SIM3 = FACTOR_CODES["landmark_sim3"]

# Codes of losses; 0: none.
NO_LOSS = 0
LOSS_CODES = {name: 1 + code for code, name in enumerate(LOSSES)}

# Scratch for a residual: six numbers at most, then what became of an observation's pixel (`lenses.layout`).
R_STATUS = 6
R_SIZE = 7
