"""Dense products that count their multiplications.  Counts are added where the multiplications are made."""

from factorbus.idp.kernels.compile import F64, kernel


@kernel("int64(float64[:,::1], float64[:,::1], float64[:,::1])")
def counted_product(a: F64, b: F64, out: F64) -> int:
    """out = a b; gives the number of multiplications.  Four columns of `a` at a time, along the rows of b.

    in   a (p, q)   b (q, r)
    out  out (p, r)
    """
    p, q, r = a.shape[0], a.shape[1], b.shape[1]
    count = 0
    for i in range(p):
        for c in range(r):
            out[i, c] = 0.0
        t = 0
        while t + 4 <= q:
            a0, a1, a2, a3 = a[i, t], a[i, t + 1], a[i, t + 2], a[i, t + 3]
            for c in range(r):
                out[i, c] += a0 * b[t, c] + a1 * b[t + 1, c] + a2 * b[t + 2, c] + a3 * b[t + 3, c]
                count += 4
            t += 4
        while t < q:
            a0 = a[i, t]
            for c in range(r):
                out[i, c] += a0 * b[t, c]
                count += 1
            t += 1
    return count
