"""What tells one insert from another of the same number, in this process and in the ones after it."""

from factorbus.service.kernels.digest import digest


def digest_of(message: bytes) -> int:
    """63 bits of `message`: the same in every process, which Python's own hash is not."""
    return int(digest(message))
