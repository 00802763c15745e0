"""Information matrices as files have them, turned into packed upper triangles of positive definite matrices."""

import numpy as np
from numpy.typing import NDArray

from factorbus.formats.errors import refuse_first
from factorbus.proto.arrays import F64, I64


def checked_information(file: str, name: str, lines: I64, packed: F64, dim: int, what: str = "an information") -> F64:
    """`packed`, if every matrix is positive definite.  Raises FormatError with the first line that is not.

    in   packed (n, dim (dim + 1) / 2): upper triangles row by row   what: matrix it is
    """
    bad = ~positive_definite(packed, dim)
    refuse_first(
        file,
        lines,
        bad,
        lambda row: (
            f"{name} with {what} matrix that is not positive definite"
            f" (smallest eigenvalue {_smallest_eigenvalue(packed[row], dim):.3g})"
        ),
        "a symmetric positive definite matrix",
    )
    return packed


def positive_definite(packed: F64, dim: int) -> NDArray[np.bool]:
    """Whether each matrix has a Cholesky factor, for all matrices at once.

    in   packed (n, dim (dim + 1) / 2)   out  (n,) bool
    """
    entry = {(i, j): packed[:, k] for k, (i, j) in enumerate(_upper(dim))}
    good = np.asarray(np.isfinite(packed).all(axis=1))
    with np.errstate(all="ignore"):  # rows already found bad may divide by zero
        for k in range(dim):
            good &= entry[k, k] > 0
            for i in range(k + 1, dim):
                ratio = entry[k, i] / entry[k, k]
                for j in range(i, dim):
                    entry[i, j] = entry[i, j] - ratio * entry[k, j]
    return good


def has_covariance(packed: F64, dim: int) -> NDArray[np.bool]:
    """Whether the inverse of each information is one that a double holds, and leads back to an information.

    in   packed (n, dim (dim + 1) / 2)   out  (n,) bool
    """
    with np.errstate(all="ignore"):
        try:
            covariance = inverted_weights(packed, dim)
            return positive_definite(covariance, dim) & positive_definite(inverted_weights(covariance, dim), dim)
        except np.linalg.LinAlgError:  # one of them is singular after rounding: which one is not said
            if len(packed) == 1:
                return np.zeros(1, bool)
            return np.concatenate([has_covariance(row[None], dim) for row in packed])


def squared(root: F64, dim: int) -> F64:
    """RᵀR of upper triangular matrices R, packed as they are.

    in   root (n, dim (dim + 1) / 2)   out  the same shape
    """
    R = unpacked_triangle(root, dim)
    return packed_upper(np.einsum("nki,nkj->nij", R, R))


def inverted_weights(packed: F64, dim: int) -> F64:
    """Information of covariances, or the other way round; both packed (n, dim (dim + 1) / 2)."""
    full = np.linalg.inv(unpacked_symmetric(packed, dim))
    return packed_upper(full / 2 + np.swapaxes(full, 1, 2) / 2)


def doubled_rotations(packed: F64) -> F64:
    """D M D, D = diag(1, 1, 1, 2, 2, 2), of packed matrices M (n, 21) of x y z and a rotation.

    Of an information in radians that is the one of half angles, which a quaternion's vector part is; of a covariance of
    half angles it is the one in radians.
    """
    scale = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
    return packed * packed_upper(np.outer(scale, scale)[None])


def unpacked_triangle(packed: F64, dim: int) -> F64:
    """Upper triangular matrices (n, dim, dim) of packed ones."""
    full = np.zeros((len(packed), dim, dim))
    rows, columns = np.triu_indices(dim)
    full[:, rows, columns] = packed
    return full


def unpacked_symmetric(packed: F64, dim: int) -> F64:
    """Symmetric matrices (n, dim, dim) of their packed upper triangles."""
    full = unpacked_triangle(packed, dim)
    return full + np.swapaxes(np.triu(full, 1), 1, 2)


def packed_upper(full: F64) -> F64:
    """Upper triangles (n, dim (dim + 1) / 2), row by row, of matrices (n, dim, dim)."""
    rows, columns = np.triu_indices(full.shape[1])
    return np.ascontiguousarray(full[:, rows, columns])


def _upper(dim: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(dim) for j in range(i, dim)]


def _smallest_eigenvalue(packed: F64, dim: int) -> float:
    upper = unpacked_triangle(packed[None], dim)[0]
    if not np.isfinite(upper).all():  # squares of very large roots
        return float("nan")
    return float(np.linalg.eigvalsh(upper, UPLO="U")[0])
