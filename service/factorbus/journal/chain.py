"""A digest of everything that a map's estimate has ever been.

    c₀ = 0,   cₙ = H(cₙ₋₁, what step n changed),   H: BLAKE2b of 128 bits

Two runs with the same chain had, at every revision, the same values to the bit.
"""

from hashlib import blake2b

from factorbus.proto import codec

START = bytes(16)


def extend_chain(chain: bytes, delta: bytes) -> bytes:
    """The chain after a step that published `delta`: its variables count, not its report."""
    digest = blake2b(chain, digest_size=16)
    message = codec.decode_delta(delta)
    digest.update(message.revision.to_bytes(8, "little"))
    for group in sorted(message.variables, key=lambda group: (group.kind, group.fixed)):
        digest.update(f"{group.kind} {group.fixed} {len(group.keys)}\n".encode())
        digest.update(group.keys.tobytes())
        if group.values is not None:
            digest.update(group.values.tobytes())
        if group.stamps is not None:
            digest.update(group.stamps.tobytes())
    return digest.digest()
