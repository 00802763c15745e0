"""Information matrices from what iSAM files carry instead."""

import math

_DIGITS = 10  # of the squared information
_ROOT_DIGITS = 7  # of the roots that iSAM's files are written with: 1.581139 for the root of 2.5


def from_root(weights: tuple[str, ...]) -> tuple[str, ...]:
    """Ω = RᵀR, each number rounded to ten digits.

    in   upper triangle of the upper triangular R, row by row (6 numbers for 3 × 3, 3 for 2 × 2)
    out  upper triangle of Ω, row by row
    """
    n = 3 if len(weights) == 6 else 2
    R = [[0.0] * n for _ in range(n)]
    numbers = map(float, weights)
    for row in range(n):
        for column in range(row, n):
            R[row][column] = next(numbers)
    return tuple(_written(sum(R[k][i] * R[k][j] for k in range(n))) for i in range(n) for j in range(i, n))


def from_covariance(weights: tuple[str, ...]) -> tuple[str, ...]:
    """The same from a diagonal covariance, by way of the rounded root that the original file has.

    So 0.4 gives 2.500000537, the square of 1.581139, as iSAM's own file does.  Raises ValueError off the diagonal.
    """
    diagonal = (0, 3, 5) if len(weights) == 6 else (0, 2)
    variances = [float(word) for word in weights]
    if any(variances[k] != 0 for k in range(len(weights)) if k not in diagonal):
        raise ValueError("a covariance that is not diagonal")
    if any(variances[k] <= 0 for k in diagonal):
        raise ValueError("a variance that is not above 0")
    roots = ["0"] * len(weights)
    for k in diagonal:
        roots[k] = f"{1 / math.sqrt(variances[k]):.{_ROOT_DIGITS}g}"
    return from_root(tuple(roots))


def _written(number: float) -> str:
    return f"{number + 0.0:.{_DIGITS}g}"  # + 0.0: no minus before a zero
