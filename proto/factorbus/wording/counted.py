"""Counts with their nouns."""


def counted(count: int, one: str, many: str = "") -> str:
    """Return the count and its noun: `0 factors`, `1 factor`, `12,345 factors`.

    many: the noun for any other count than one, where that is not `one` with an s.
    """
    return f"{count:,} {one if count == 1 else many or f'{one}s'}"
