"""Joint compatibility branch and bound: which observation is of which landmark, all of them together.  MATH §10.4.

After Neira and Tardós, "Data association in stochastic mapping using the joint compatibility test" (2001).
"""

import math

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel


@kernel("int64(int64[::1], int64[::1], float64[:,::1], float64[:,::1], float64[::1], int64, int64[::1])")
def search(begin: I64, landmark: I64, S: F64, r: F64, gates: F64, budget: int, best: I64) -> int:
    """The largest set of pairs that is jointly compatible; among equals that with the least joint d².

    in   begin (n + 1,): the pairs of observation i are begin[i] .. begin[i + 1]−1, best first
         landmark (pairs,): 0 or more   gates (n + 1,): d² allowed for 0 .. n pairs
         S (pairs·dim, pairs·dim): joint covariance of all innovations   r (pairs, dim)
         budget: pairs that are tried at most
    out  best (n,): the pair of each observation, −1: none
         returns how many pairs were tried; unless that is above the budget, no set is better
    """
    n, dim, landmarks = begin.size - 1, r.shape[1], 0
    for q in range(landmark.size):
        landmarks = max(landmarks, landmark[q] + 1)
    taken = np.zeros(landmarks, np.int64)
    chosen, position, depth_of = np.full(n, -1), np.empty(n + 1, np.int64), np.zeros(n + 1, np.int64)
    L, y, total = np.zeros((n * dim, n * dim)), np.zeros(n * dim), np.zeros(n + 1)
    picked = np.empty(n, np.int64)
    best[:] = -1
    most, least, tried, t = -1, 0.0, 0, 0
    position[0] = begin[0]
    while t >= 0:
        if t == n:
            k = depth_of[n]
            if total[k] <= gates[k] and (k > most or (k == most and total[k] < least)):
                most, least = k, total[k]
                for q in range(n):
                    best[q] = chosen[q]
            t -= 1
            continue
        k = depth_of[t]
        if chosen[t] >= 0:  # come back from below: what was picked is put back
            taken[landmark[chosen[t]]] = 0
            chosen[t] = -1
        q, found = position[t], False
        # Nothing below can be better than the best: as many pairs are out of reach, or at no less.
        hopeful = k + n - t > most or (k + n - t == most and total[k] < least)
        while hopeful and q < begin[t + 1] and not found:
            if taken[landmark[q]] == 0:
                tried += 1
                if tried > budget:
                    return tried
                d2 = total[k] + append_pair(k, q, picked, S, r, L, y)
                if d2 <= gates[k + n - t]:  # d² only grows: as large a set as can still come would be refused
                    found = True
                    picked[k], total[k + 1] = q, d2
            q += 1
        if found:
            position[t], chosen[t] = q, q - 1
            taken[landmark[q - 1]] = 1
            depth_of[t + 1] = k + 1
        elif hopeful and q == begin[t + 1] and k + n - t - 1 >= most:
            position[t] = q + 1  # left out, once
            depth_of[t + 1] = k
        else:
            t -= 1
            continue
        t += 1
        if t < n:
            position[t] = begin[t]
    return tried


@inline_kernel
def append_pair(k: int, q: int, picked: I64, S: F64, r: F64, L: F64, y: F64) -> float:
    """Rows k·dim .. of the Cholesky factor of the innovations, pair q the last; returns what d² grows by."""
    dim = r.shape[1]
    increase = 0.0
    for a in range(dim):
        row, source = k * dim + a, q * dim + a
        for c in range(row + 1):
            j = c // dim
            other = q if j == k else picked[j]
            value = S[source, other * dim + c % dim]
            for e in range(c):
                value -= L[row, e] * L[c, e]
            L[row, c] = math.sqrt(value) if c == row else value / L[c, c]
        value = r[q, a]
        for e in range(row):
            value -= L[row, e] * y[e]
        y[row] = value / L[row, row]
        increase += y[row] * y[row]
    return float(increase)
