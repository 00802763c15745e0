"""Subtrees of an elimination that several threads can eliminate, each its own.  MATH §9.5."""

import numpy as np

from factorbus.solver.kernels.jit.compile import I64, part
from factorbus.solver.kernels.sparse import fronts as fr

# Columns of a subtree, fronts FIRST .. END: when it is eliminated what failed, or −1, and flops.
FIRST, END, FAILED, FLOPS = 0, 1, 2, 3
TURN = 4  # of the row k: the subtree that is eliminated as the k-th one; those that take longest come first
SUBTREE = 5

WHOLE_WORKERS = 3  # a whole factorization is cut for as many, however many there are: its update matrices lie so
PIECES = 3  # for each thread; with more of them more is left above, where there is less to share
# What a front takes besides the flops of its pivots, in those: to assemble it, by scalars², and as such.  Measured.
ASSEMBLY, BOOKKEEPING = 150, 80_000
LONG = 30_000_000  # an elimination that is worth sharing, half a millisecond
WAITING = 0.25  # of the numbers of R of a subtree: what update matrices may wait behind it for what is above


@part
def cut_subtrees(records: I64, workers: int) -> I64:
    """Subtrees of neighbours in postorder that take a small share of the whole; none where it is not worth it."""
    count = len(records)
    takes, first = np.zeros(count), np.arange(count)  # with all below
    total = 0.0
    for f in range(count):
        scalars = records[f, fr.PIVOTS] + records[f, fr.SEPARATOR] + 1
        own = (records[f, fr.PIVOTS] + ASSEMBLY) * scalars * scalars + BOOKKEEPING
        takes[f] += own
        total += own
        above = records[f, fr.PARENT]
        if above >= 0:
            takes[above] += takes[f]
            first[above] = min(first[above], first[f])
    if total < LONG:
        return np.empty((0, SUBTREE), np.int64)
    cut, size, pieces = np.empty((count, SUBTREE), np.int64), np.empty(count), 0
    most = total / (PIECES * (1 + workers))
    for f in range(count):
        above = records[f, fr.PARENT]
        if takes[f] > most or (above >= 0 and takes[above] <= most):
            continue
        if pieces > 0 and cut[pieces - 1, END] == first[f] and size[pieces - 1] + takes[f] <= most:
            size[pieces - 1] += takes[f]
        else:
            cut[pieces, FIRST], size[pieces] = first[f], takes[f]
            pieces += 1
        cut[pieces - 1, END] = f + 1
    for turn in range(pieces):
        largest = 0
        for k in range(1, pieces):
            if size[k] > size[largest]:
                largest = k
        cut[turn, TURN], size[largest] = largest, -1.0
    return cut[:pieces]


@part
def cut_whole(records: I64) -> I64:
    """As `cut_subtrees`, whatever number of worker threads there is, for a factorization in which each subtree has
    stacks of its own: without those behind which much waits, as behind points that cameras see."""
    cut = cut_subtrees(records, WHOLE_WORKERS)
    kept, number = np.empty_like(cut), np.full(len(cut), -1)
    count = 0
    for k in range(len(cut)):
        own, waiting = 0, 0
        for f in range(cut[k, FIRST], cut[k, END]):
            p, m, above = records[f, fr.PIVOTS], records[f, fr.SEPARATOR], records[f, fr.PARENT]
            own += p * (p + m)
            if above < 0 or above >= cut[k, END]:
                waiting += fr.update_size(m, fr.padded_size(m))
        if waiting <= WAITING * own:
            kept[count, FIRST], kept[count, END], number[k] = cut[k, FIRST], cut[k, END], count
            count += 1
    turn = 0
    for k in range(len(cut)):
        if number[cut[k, TURN]] >= 0:
            kept[turn, TURN] = number[cut[k, TURN]]
            turn += 1
    return kept[:count]
