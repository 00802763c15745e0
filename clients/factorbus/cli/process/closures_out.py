"""Loop closures that a map has and its estimate does not: no file of its graph has them, and that is said."""

from typing import TYPE_CHECKING

from factorbus.wording import counted

if TYPE_CHECKING:
    from factorbus.client import Map
    from factorbus.formats import FileNotes


def closures_out(joined: "Map", timeout_s: float) -> "FileNotes":
    """What a file of the graph of a map leaves out of its closures; nothing where they are trusted.

    Raises Refused, Unavailable.
    """
    from factorbus.formats import FileNotes

    if joined.closures == "trust":
        return FileNotes()
    found = joined.suspects(timeout_s=timeout_s)
    weighed = found.policy == "robust"  # a suspect is a factor of the estimate, then, unless it is outweighed
    out = sum(
        not weighed or state != "suspect" or reason == "outweighed"
        for state, reason in zip(found.states, found.reasons, strict=True)
    )
    if not out:
        return FileNotes()
    why = f"the estimate does not have {'it' if out == 1 else 'them'}, as `factorbus ask suspects {joined.name}` says"
    return FileNotes((f"{counted(out, 'loop closure')} left out: {why}",), {"loop closures": out})
