"""Substitution with the rows of one clique, three right-hand sides at a time: R is read once for all of them."""

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels import tree_layout as tl

COLUMNS = 3


@part
def forward(
    row: I64, lists: I64, numbers: F64, dims: I64, scalar: I64, first: int, places: I64, local: F64, x: F64
) -> None:
    """x_F := R_F⁻ᵀ x_F,  x_S −= R_Sᵀ x_F, for the rows `first` .. `first` + 2 of x.

    scalar: where each variable starts in a row of x   places (w,), local (3, w): scratch
    """
    p, width, ld = row[tl.C_PIVOTS], row[tl.C_PIVOTS] + row[tl.C_BORDER], row[tl.C_LD]
    list_scalars(row, row[tl.C_FRONTALS] + row[tl.C_SEPARATORS], lists, dims, scalar, places)
    y0, y1, y2 = local[0], local[1], local[2]
    x0, x1, x2 = x[first], x[first + 1], x[first + 2]
    top = p
    for i in range(p - 1, -1, -1):
        y0[i], y1[i], y2[i] = x0[places[i]], x1[places[i]], x2[places[i]]
        if y0[i] != 0.0 or y1[i] != 0.0 or y2[i] != 0.0:
            top = i
    if top == p:
        return
    for k in range(p, width):
        y0[k], y1[k], y2[k] = x0[places[k]], x1[places[k]], x2[places[k]]
    for i in range(top, p):
        start = row[tl.C_ROWS] + i * ld
        inverse = 1.0 / numbers[start + i]
        y0[i] *= inverse
        y1[i] *= inverse
        y2[i] *= inverse
        f0, f1, f2 = y0[i], y1[i], y2[i]
        line, z0, z1, z2 = numbers[start + i + 1 : start + width], y0[i + 1 :], y1[i + 1 :], y2[i + 1 :]
        for k in range(width - i - 1):
            z0[k] -= f0 * line[k]
            z1[k] -= f1 * line[k]
            z2[k] -= f2 * line[k]
    for k in range(top, width):
        x0[places[k]], x1[places[k]], x2[places[k]] = y0[k], y1[k], y2[k]


@part
def backward(
    row: I64, lists: I64, numbers: F64, dims: I64, scalar: I64, first: int, places: I64, local: F64, x: F64
) -> None:
    """x_F := R_F⁻¹ (x_F − R_S x_S), likewise."""
    p, width, ld = row[tl.C_PIVOTS], row[tl.C_PIVOTS] + row[tl.C_BORDER], row[tl.C_LD]
    list_scalars(row, row[tl.C_FRONTALS] + row[tl.C_SEPARATORS], lists, dims, scalar, places)
    y0, y1, y2 = local[0], local[1], local[2]
    x0, x1, x2 = x[first], x[first + 1], x[first + 2]
    for k in range(width):
        y0[k], y1[k], y2[k] = x0[places[k]], x1[places[k]], x2[places[k]]
    for i in range(p - 1, -1, -1):
        start = row[tl.C_ROWS] + i * ld
        line, z0, z1, z2 = numbers[start + i + 1 : start + width], y0[i + 1 :], y1[i + 1 :], y2[i + 1 :]
        t0, t1, t2 = 0.0, 0.0, 0.0
        for k in range(width - i - 1):
            t0 += line[k] * z0[k]
            t1 += line[k] * z1[k]
            t2 += line[k] * z2[k]
        inverse = 1.0 / numbers[start + i]
        y0[i], y1[i], y2[i] = (y0[i] - t0) * inverse, (y1[i] - t1) * inverse, (y2[i] - t2) * inverse
        x0[places[i]], x1[places[i]], x2[places[i]] = y0[i], y1[i], y2[i]


@inline_kernel
def list_scalars(row: I64, count: int, lists: I64, dims: I64, scalar: I64, places: I64) -> None:
    """Where the scalars of the first `count` variables of a clique's list are."""
    k = 0
    for s in range(row[tl.C_LIST], row[tl.C_LIST] + count):
        start = scalar[lists[s]]
        for a in range(dims[lists[s]]):
            places[k] = start + a
            k += 1
