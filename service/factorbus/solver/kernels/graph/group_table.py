"""The table that admission reads: groups of variables and factors whose columns lie in the bytes of a message.

A row for each group, in any order, and after the last one a row of kind END.  A column is given by the offset of its
first byte: little-endian numbers of eight bytes, row after row without gaps.
"""

# Columns.
G_KIND = 0  # the code of the kind
G_FACTORS = 1  # 0: variables, 1: factors
G_COUNT = 2
G_FIXED = 3  # 1: variables that are held where they are
G_LOSS = 4  # code of the loss of factors
G_KEYS = 5  # offset of the keys
G_NUMBERS = 6  # of the values, NOWHERE: they come without; or of the measurements
G_INFORMATION = 7  # of the upper triangles of the information matrices
G_SCALE = 8  # of the scales of the loss; NOWHERE: there is none
G_STAMPS = 9  # of the time stamps of variables; NOWHERE: they have none
G_LIMITED = 10  # 1: the lenses of what a camera saw have their limits
G_ARITY = 11  # of linear, inertial and own kinds, whose sizes are no other kind's: how many variables they have,
G_ROWS = 12  # numbers of a residual,
G_SIZE = 13  # numbers measured of each factor,
G_ENDS = 14  # and the offset of the codes of the kinds of their variables, as int64; of all others NOWHERE
G_HEAD = 15  # of own kinds: the offset of what stands before the measurement, NOWHERE: it is none,
G_LENGTH = 16  # and how many numbers that are
G_WIDTH = 17

END = -1
NOWHERE = -1

# What is wrong with a row of a group.
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
BAD_DURATION = 16  # a sample of an IMU that lasts no time
BAD_NOISE = 17  # a sensor without noise, or whose noise leaves something certain

# Of a factor that `many` evaluates: for each variable before the one that is wrong, to what is wrong of the first.
LATER_END = 100

# What else admission may find, before it takes anything or after it took all.
NO_ROOM = 13  # the arenas of the graph are too short
NO_LIMITS = 14  # what a camera saw has not got the limits of its lens
COMPOSED_OUT_OF_BOUNDS = 15  # a value that was composed; the row is the index of the variable

# Bits of what is left to be done for groups that are in order.
UNREACHED = 1  # a variable without a value that factors do not lead to: bearings may
OBSERVED = 2  # what cameras saw may be impossible
OWN = 4  # residuals of own kinds may be no numbers
