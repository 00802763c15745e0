"""Block systems Λ to try the linear algebra on: random ones, generated worlds, and those of g2o files.

A linearization point is not needed for what is tested here, only the pattern and sensible numbers, so a relative
measurement z has the Jacobians −Ad(z⁻¹) and I, and a landmark those of a robot that never turns.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Edge = tuple[int, int, F64, F64, F64]  # i, j, ∂r/∂xᵢ, ∂r/∂xⱼ, Ω;  i = -1: not there


@dataclass(frozen=True)
class BlockSystem:
    """Λ as blocks: rows[b] <= cols[b], block b row-major at data[offsets[b]:], diagonal blocks present."""

    dims: I64
    rows: I64
    cols: I64
    data: F64
    offsets: I64

    @property
    def starts(self) -> I64:
        """First scalar of each variable, and the total."""
        return np.concatenate(([0], np.cumsum(self.dims)))

    def blocks(self) -> Iterable[tuple[int, int, F64]]:
        """(row, column, block) one after another."""
        for i, j, at in zip(self.rows.tolist(), self.cols.tolist(), self.offsets.tolist(), strict=True):
            shape = int(self.dims[i]), int(self.dims[j])
            yield i, j, self.data[at : at + shape[0] * shape[1]].reshape(shape)

    def dense(self) -> F64:
        """Λ as a full symmetric matrix."""
        return self.sparse().toarray()

    def sparse(self) -> csc_array:
        """Λ as a symmetric scipy matrix of scalars."""
        start = self.starts
        values, rows, cols = [np.empty(0)], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        for i, j, block in self.blocks():
            row, col = np.meshgrid(np.arange(block.shape[0]), np.arange(block.shape[1]), indexing="ij")
            row, col = (row + start[i]).ravel(), (col + start[j]).ravel()
            keep = row <= col if i == j else np.ones(len(row), bool)
            upper = (row[keep], col[keep], block.ravel()[keep])
            off = upper[0] != upper[1]
            rows += [upper[0], upper[1][off]]
            cols += [upper[1], upper[0][off]]
            values += [upper[2], upper[2][off]]
        n = int(start[-1])
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols)))
        return csc_array(coo_array(entries, shape=(n, n)))


def from_edges(dims: Iterable[int], edges: Iterable[Edge], anchor: float = 0.0) -> BlockSystem:
    """Sum the information of edges; `anchor` is added to the diagonal."""
    dims = np.asarray(list(dims), np.int64)
    blocks: dict[tuple[int, int], F64] = {(v, v): anchor * np.eye(d) for v, d in enumerate(dims.tolist())}
    for i, j, A, B, information in edges:
        ends = [(v, J) for v, J in ((i, A), (j, B)) if v >= 0]
        for a, Ja in ends:
            for b, Jb in ends:
                if a <= b:
                    blocks[a, b] = blocks.get((a, b), 0.0) + Ja.T @ information @ Jb
    return pack(dims, blocks)


def pack(dims: I64, blocks: dict[tuple[int, int], F64]) -> BlockSystem:
    """Blocks in the order of their first use, one after another."""
    keys = np.array(list(blocks), np.int64).reshape(-1, 2)
    sizes = [block.size for block in blocks.values()]
    offsets = np.concatenate(([0], np.cumsum(sizes)[:-1])).astype(np.int64) if sizes else np.empty(0, np.int64)
    data = np.concatenate([block.ravel() for block in blocks.values()]) if sizes else np.empty(0)
    return BlockSystem(dims, keys[:, 0].copy(), keys[:, 1].copy(), data, offsets)


def random_system(seed: int, dims: Iterable[int], pairs: Iterable[tuple[int, int]]) -> BlockSystem:
    """A positive definite Λ with the given variable sizes and the given pairs of neighbours."""
    rng = np.random.default_rng(seed)
    dims = list(dims)
    edges = []
    for i, j in pairs:
        A, B = rng.normal(size=(4, dims[i])), rng.normal(size=(4, dims[j]))
        edges.append((i, j, A, B, np.eye(4)))
    return from_edges(dims, edges, anchor=0.5)


def grid(side: int, dim: int = 3) -> BlockSystem:
    """A square grid of variables, each tied to its neighbours; the first is anchored."""
    rng = np.random.default_rng(side)
    edges = [(-1, 0, np.eye(dim), np.eye(dim), 100.0 * np.eye(dim))]
    for v in range(side * side):
        for w in (v + 1 if v % side < side - 1 else -1, v + side if v < side * (side - 1) else -1):
            if w >= 0:
                J = np.eye(dim) + 0.1 * rng.normal(size=(dim, dim))
                edges.append((v, w, -J, np.eye(dim), 50.0 * np.eye(dim)))
    return from_edges([dim] * side**2, edges)


@cache
def from_g2o(path: Path) -> BlockSystem:
    """The system of a g2o file with vertex 0 held fixed."""
    edges: list[Edge] = []
    dims: dict[int, int] = {}
    for line in path.read_text().splitlines():
        word, *fields = line.split()
        if not word.startswith("EDGE"):
            continue
        i, j, numbers = int(fields[0]), int(fields[1]), np.array(fields[2:], float)
        A, B, information = _EDGES[word](numbers)
        dims[i], dims[j] = A.shape[1], B.shape[1]
        edges.append((i - 1, j - 1, A, B, information))
    return from_edges([dims[v] for v in range(1, len(dims))], edges)


def _edge_se2(numbers: F64) -> tuple[F64, F64, F64]:
    x, y, theta = numbers[:3]
    c, s = np.cos(theta), np.sin(theta)
    inverse = np.array([[c, s, s * x - c * y], [-s, c, c * x + s * y], [0, 0, 1]])
    return -inverse, np.eye(3), _symmetric(numbers[3:], 3)


def _edge_se2_xy(numbers: F64) -> tuple[F64, F64, F64]:
    x, y = numbers[:2]
    return np.array([[-1, 0, y], [0, -1, -x]]), np.eye(2), _symmetric(numbers[2:], 2)


def _edge_se3(numbers: F64) -> tuple[F64, F64, F64]:
    x, y, z, *q = numbers[:7]
    R = _rotation(np.array(q)).T
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return -np.block([[R, -R @ cross], [np.zeros((3, 3)), R]]), np.eye(6), _symmetric(numbers[7:], 6)


def _rotation(q: F64) -> F64:
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _symmetric(upper: F64, n: int) -> F64:
    full = np.zeros((n, n))
    full[np.triu_indices(n)] = upper
    return full + np.triu(full, 1).T


_EDGES = {"EDGE_SE2": _edge_se2, "EDGE_SE2_XY": _edge_se2_xy, "EDGE_SE3:QUAT": _edge_se3}


@st.composite
def systems(draw: st.DrawFn, most: int = 14) -> BlockSystem:
    """Positive definite systems of a few variables, sizes mixed, chains, stars, unconnected parts and full ones."""
    dims = draw(st.lists(st.sampled_from([1, 2, 3, 6, 7]), min_size=1, max_size=most))
    n = len(dims)
    pair = st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)).filter(lambda p: p[0] < p[1])
    pairs = set(draw(st.lists(pair, max_size=3 * n))) if n > 1 else set()
    shape = draw(st.sampled_from(["as drawn", "chain", "star", "full"]))
    if shape == "chain":
        pairs |= {(v, v + 1) for v in range(n - 1)}
    elif shape == "star":
        pairs |= {(0, v) for v in range(1, n)}
    elif shape == "full":
        pairs = {(i, j) for i in range(n) for j in range(i + 1, n)}
    return random_system(draw(st.integers(0, 2**32 - 1)), dims, sorted(pairs))
