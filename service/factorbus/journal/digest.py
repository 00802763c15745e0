"""What tells that an entry is still the one that was written: every bit of it counts, not only the insert's bytes."""

from hashlib import blake2b

from factorbus.journal.records import Entry


def sealed(entry: Entry) -> Entry:
    """`entry` with its digest."""
    return entry._replace(digest=digest_of(entry))


def digest_of(entry: Entry) -> int:
    """64 bits of all else in `entry`: the same in every process and version."""
    _, _, _, outcome, revision, first_factor, together, answer, message = entry
    digest = blake2b(digest_size=8)
    digest.update(f"{entry.client} {entry.sequence} {outcome} {revision} {first_factor} {together} ".encode())
    digest.update(len(answer).to_bytes(8, "little"))
    digest.update(answer)
    digest.update(message)
    return int.from_bytes(digest.digest(), "little", signed=True)
