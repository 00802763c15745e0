"""What was probably meant by a name that does not exist."""

import difflib
from collections.abc import Iterable


def nearest(name: object, known: Iterable[str]) -> str:
    """`; did you mean 'loss'?` for the most alike of `known`, or an empty string where none is alike."""
    alike = difflib.get_close_matches(str(name).lower(), list(known), n=1, cutoff=0.55)
    return f"; did you mean {alike[0]!r}?" if alike else ""
