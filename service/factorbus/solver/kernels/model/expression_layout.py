"""How an own kind lies in a factor's payload, before its measurement.  MATH §3.11."""

X_BEFORE = 0  # numbers before the information: of all this, and of what is measured
X_NUMBER = 1  # of the kind, and of the function that computes it (`jit/machine_code.py`)
X_QUATERNION = 2  # where in the measurement a quaternion begins; −1: nowhere
X_RIGID = 3  # 1: of a pose and what it sees, and the residual stays as both move as one body
X_WIDTH = 4  # numbers of this alone
NUMBER_BITS = 48  # exact as a float64
