"""What was probably meant by a name that does not exist."""

import difflib
from collections.abc import Iterable

_MOST_LISTED = 16  # kinds in one text


def nearest(name: object, known: Iterable[str]) -> str:
    """`; did you mean 'loss'?` for the most alike of `known`, or an empty string where none is alike."""
    alike = difflib.get_close_matches(str(name).lower(), list(known), n=1, cutoff=0.55)
    return f"; did you mean {alike[0]!r}?" if alike else ""


def few_of(kind: str, known: tuple[str, ...]) -> str:
    """All of `known`; of many those that end as `kind` does, which is with the variable joined, and where all are."""
    if len(known) <= _MOST_LISTED:
        return ", ".join(known)
    end = f"_{kind.rpartition('_')[2]}"
    same = [name for name in known if name.endswith(end)]
    listed = f"{', '.join(same[:_MOST_LISTED])}{', ... ' if same else ''}those that `factorbus kinds` lists"
    return ", ".join([listed, *(name for name in known if not name.isidentifier())])  # such as "or a formula"


def largest_of(kind: str, known: tuple[str, ...]) -> str:
    """Of a size that there is not, as vector10, the largest that there is."""
    stem = kind.rstrip("0123456789")
    sizes = [int(name[len(stem) :]) for name in known if name.startswith(stem) and name[len(stem) :].isdecimal()]
    return f"; {stem}{max(sizes)} is the largest" if stem != kind and len(sizes) > 3 else ""
