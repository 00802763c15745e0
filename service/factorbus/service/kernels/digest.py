"""What tells one message from another, in 63 bits: the same in every process and on every machine."""

import numpy as np

from factorbus.service.kernels.compile import inline_kernel, kernel

_HALF = 0xFFFFFFFF
# Odd, and below 2³¹, so that no product of them and half a word leaves an int64.
_FIRST, _SECOND = 0x45D9F3B, 0x2C1B3C6D


@kernel("int64(Bytes(uint8, 1, 'C', readonly=True))")
def digest(raw: bytes) -> int:
    """The digest of a message."""
    return digest_bytes(raw)


@inline_kernel
def digest_bytes(raw: bytes) -> int:
    """Two hashes of 32 bits, every step of which can be undone: messages that differ in one place have other ones.

    Not for secrets.  Who makes two of its own messages with one digest gets one answer for both.
    """
    size, first, second = len(raw), _FIRST, _SECOND
    for k in range(0, size + 4, 4):
        bits = np.int64(0)
        for j in range(k, min(k + 4, size)):
            bits |= np.int64(raw[j]) << np.int64(8 * (j - k))
        if k >= size:
            bits = np.int64(size)  # the last word: zeros at the end are told apart
        first = ((first ^ bits) * _FIRST) & _HALF
        first ^= first >> 16
        second = ((second ^ bits) * _SECOND) & _HALF
        second ^= second >> 15
    return ((first & 0x7FFFFFFF) << 32) | second  # type: ignore[return-value]
