"""Questions about the set of maps, read and judged: which name, which mode, is it ours."""

from factorbus.proto import codec
from factorbus.proto.keys import checked_name
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.problems import BadMessage, Problem
from factorbus.solver.errors import UnknownMode
from factorbus.solver.modes import MODES, mode_named


class OtherMode(Problem):
    """The map is there, in another mode than asked for."""

    code = "other_mode"

    def __init__(self, name: str, mode: str, wanted: str) -> None:
        super().__init__(f"map {name!r} is in mode {mode}, not {wanted}; join it as {mode} or drop it", mode=mode)


class MovedOn(Problem):
    """The map is not at the revision that whoever wants to drop it has in mind."""

    code = "moved_on"

    def __init__(self, name: str, revision: int, wanted: int, waiting: int) -> None:
        more = f" and {waiting} inserts under way" if waiting else ""
        super().__init__(
            f"map {name!r} is at revision {revision}{more}, not at {wanted}: it was not dropped; copy it again, or "
            "have its front ends leave first",
            revision=revision,
            waiting=waiting,
        )


class NotHere(Problem):
    """This service does not keep maps of that name."""

    code = "unknown_map"

    def __init__(self, name: str, pattern: str) -> None:
        super().__init__(f"this service keeps maps named {pattern}; {name!r} is not one of them", maps=pattern)


def read_create(payload: bytes) -> tuple[str, str]:
    """(map, mode) of an admin/create.  Raises BadMessage, BadName, TooLarge."""
    content = codec.decode_map(payload, REQUEST_LIMITS, what="create")
    mode = content.get("mode", "auto")
    try:
        mode_named(mode if isinstance(mode, str) else "")
    except UnknownMode as unknown:
        raise BadMessage("create.mode", f"is {mode!r:.40}", f"one of {', '.join(MODES)}") from unknown
    return _map_name(content, "create"), mode


def read_drop(payload: bytes) -> tuple[str, int | None]:
    """(map, revision) of an admin/drop; the revision is None if any will do.  Raises BadMessage, BadName, TooLarge."""
    content = codec.decode_map(payload, REQUEST_LIMITS, what="drop")
    revision = content.get("revision")
    if revision is not None and (type(revision) is not int or revision < 0):
        raise BadMessage("drop.revision", f"is {revision!r:.40}", "a revision, from 0")
    return _map_name(content, "drop"), revision


def settled_mode(mode: str) -> str:
    """What a map asked for in `mode` runs as."""
    return mode_named(mode).name


def ours(pattern: str, name: str) -> bool:
    """Does a service that keeps `pattern` (a name, or a beginning and *) keep `name`?"""
    return name.startswith(pattern[:-1]) if pattern.endswith("*") else name == pattern


def _map_name(content: dict, where: str) -> str:
    name = content.get("map")
    if type(name) is not str:
        raise BadMessage(f"{where}.map", "missing" if name is None else f"is {name!r:.40}", "the name of a map")
    return checked_name("map", name)
