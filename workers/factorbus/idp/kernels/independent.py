"""The covariance of new features by independent rows of blocks, as Idris and others have it (2011).  MATH §5.2.

    left_i = A_i P_v,   right_i = P_vᵀ A_iᵀ,   own_i = B_i Padd B_iᵀ
    P(new i, before) = left_i,   P(before, new i) = right_i
    P(new i, new k) = left_i[:, camera] A_kᵀ  (+ own_i where i = k)                             (5.3)

No feature waits for another one.  Everything is multiplied out, zeros included, as in the paper.
"""

from factorbus.idp.kernels.compile import F64, I64, inline_kernel, kernel
from factorbus.idp.kernels.layout import CAMERA, FEATURE

# Entries of `counts`.
LEFT, RIGHT, OWN_LEFT, OWN, BLOCKS = 0, 1, 2, 3, 4
COUNTS = 5


@kernel("void(int64, int64, float64[:,::1], float64[:,:,::1], float64[:,::1], int64[::1])")
def camera_blocks(first: int, last: int, before: F64, A: F64, out: F64, counts: I64) -> None:
    """Between the new features first .. last−1 and all that was there before: left and right.

    in   before (13, m): the camera's rows of P before   A (n, 6, 13)
    out  out (m + 6 n, m + 6 n)   counts (5,): multiplications are added
    """
    m = before.shape[1]
    for i in range(first, last):
        row = m + FEATURE * i
        for a in range(FEATURE):
            for c in range(m):
                total = 0.0
                for t in range(CAMERA):
                    total += A[i, a, t] * before[t, c]
                    counts[LEFT] += 1
                out[row + a, c] = total
        for c in range(m):
            for a in range(FEATURE):
                total = 0.0
                for t in range(CAMERA):
                    total += before[t, c] * A[i, a, t]
                    counts[RIGHT] += 1
                out[c, row + a] = total


@kernel("void(int64, int64, float64[:,::1], float64[:,::1], int64[::1])")
def feature_blocks(first: int, last: int, At: F64, out: F64, counts: I64) -> None:
    """Between the new features first .. last−1 and all new ones, by what `camera_blocks` left in `out`.

    in   At (13, 6 n): all A_kᵀ side by side
    """
    width = At.shape[1]
    m = len(out) - width
    for i in range(first, last):
        for a in range(m + FEATURE * i, m + FEATURE * (i + 1)):
            counts[BLOCKS] += row_of_blocks(out[a, :CAMERA], At, out[a, m : m + width])


@kernel("void(int64, int64, float64[:,:,::1], float64[:,::1], float64[:,::1], float64[:,::1], int64[::1])")
def add_own_blocks(first: int, last: int, B: F64, padd: F64, own: F64, out: F64, counts: I64) -> None:
    """What is added to the block of each new feature with itself, after `feature_blocks`.

    in   B (n, 6, 3)   padd (3, 3)
    work own (12, 6)
    """
    m = len(out) - FEATURE * len(B)
    for i in range(first, last):
        row = m + FEATURE * i
        counts[OWN_LEFT] += pixel_left(B[i], padd, own)
        counts[OWN] += pixel_block(B[i], own)
        for a in range(FEATURE):
            for b in range(FEATURE):
                out[row + a, row + b] += own[FEATURE + a, b]


@inline_kernel
def row_of_blocks(left: F64, At: F64, out: F64) -> int:
    """out = left At for one row: 13 numbers times (13, 6 n)."""
    l0, l1, l2, l3, l4, l5, l6 = left[0], left[1], left[2], left[3], left[4], left[5], left[6]
    l7, l8, l9, l10, l11, l12 = left[7], left[8], left[9], left[10], left[11], left[12]
    count = 0
    for c in range(out.size):
        out[c] = (
            l0 * At[0, c] + l1 * At[1, c] + l2 * At[2, c] + l3 * At[3, c] + l4 * At[4, c] + l5 * At[5, c]
            + l6 * At[6, c] + l7 * At[7, c] + l8 * At[8, c] + l9 * At[9, c] + l10 * At[10, c] + l11 * At[11, c]
            + l12 * At[12, c]
        )  # fmt: skip
        count += 13
    return count


@inline_kernel
def pixel_left(B: F64, padd: F64, own: F64) -> int:
    """B Padd into the first six rows of `own`, 6 × 3."""
    count = 0
    for a in range(FEATURE):
        for c in range(3):
            total = 0.0
            for t in range(3):
                total += B[a, t] * padd[t, c]
                count += 1
            own[a, c] = total
    return count


@inline_kernel
def pixel_block(B: F64, own: F64) -> int:
    """(B Padd) Bᵀ into the last six rows of `own`."""
    count = 0
    for a in range(FEATURE):
        for b in range(FEATURE):
            total = 0.0
            for t in range(3):
                total += own[a, t] * B[b, t]
                count += 1
            own[FEATURE + a, b] = total
    return count
