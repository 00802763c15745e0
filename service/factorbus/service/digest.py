"""What tells one insert from another of the same number, in this process and in the ones after it."""

from hashlib import blake2b


def digest_of(message: bytes) -> int:
    """64 bits of `message`: the same in every process, which Python's own hash is not."""
    return int.from_bytes(blake2b(message, digest_size=8).digest(), "little", signed=True)
