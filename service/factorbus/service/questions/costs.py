"""What answers of questions about uncertainty come to in bytes, and what computing them takes beside.

Memory as an upper bound.  Of an answer the numbers, without keys and names: all of it is measured when it is made.
"""

from typing import NamedTuple

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.service.questions.question_memory import COPIES
from factorbus.solver.covariance.blocks import CovarianceBlocks

_NUMBER = 8
# Of a candidate beside its blocks: keys, measurement, information, row of the graph, what is told of it.
_OF_A_CANDIDATE = 1024
# Of a block beside its numbers: the variable's row, key and kind, and their copies; measured, 137 in the plane.
_OF_A_BLOCK = 160
# Blocks of a candidate, as wide as the largest variable: of both ends, between them, H Σ Hᵀ, and copies of these.
_BLOCKS = 8


class Cost(NamedTuple):
    """Bytes: of the answer, and of memory until it is sent, the answer included."""

    answer: int
    memory: int


def of_matrix(blocks: CovarianceBlocks, rows: I64, columns: I64) -> Cost:
    """One matrix of the covariance, between two lists of variables."""
    dims = blocks.factored.dims
    height, width = int(dims[rows].sum()), int(dims[columns].sum())
    answer = _NUMBER * height * width
    if blocks.prefers_columns(rows, columns):
        # Blocks of one with all others, and what cut out of them is put together.
        each = blocks.width * blocks.width * (max(len(rows), len(columns)) + 2 * blocks.factored.count)
        return Cost(answer, _NUMBER * each + (2 + COPIES) * answer)
    different = np.unique(np.concatenate([rows, columns]))
    inner = int(dims[different].sum())
    substituted = (blocks.path_scalars(different) + inner) * (inner + 16)
    return Cost(answer, _NUMBER * (substituted + 2 * inner * inner) + COPIES * answer)


def of_blocks(blocks: CovarianceBlocks, variables: I64) -> Cost:
    """Blocks of single variables."""
    dims, width = blocks.factored.dims, blocks.width
    answer = _NUMBER * int((dims[variables] ** 2 + 1).sum())
    whole = 2 * blocks.factored.count if blocks.prefers_all(variables.size) else 0
    memory = _NUMBER * width * width * (whole + variables.size) + _OF_A_BLOCK * variables.size
    return Cost(answer, memory + COPIES * answer)


def of_candidates(blocks: CovarianceBlocks, count: int, numbers: int) -> Cost:
    """Candidate factors, with `numbers` numbers in the answer for each."""
    square, answer = blocks.width * blocks.width, _NUMBER * numbers * count
    whole = 2 * blocks.factored.count if blocks.prefers_all(2 * count) else 0
    memory = _NUMBER * square * (whole + _BLOCKS * count) + _OF_A_CANDIDATE * count
    return Cost(answer, memory + COPIES * answer)


def of_joint_innovations(blocks: CovarianceBlocks, variables: I64, numbers: int) -> int:
    """Memory for the covariance of `numbers` numbers that candidates on `variables` measure, all together."""
    inner = int(blocks.factored.dims[variables].sum())
    substituted = (blocks.path_scalars(variables) + inner) * (inner + 16)
    return _NUMBER * (substituted + 3 * inner * inner + 2 * numbers * inner + 3 * numbers * numbers)
