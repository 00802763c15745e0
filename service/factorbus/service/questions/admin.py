"""Questions about the set of maps, read and judged: which name, which mode, is it ours."""

from typing import NamedTuple

from factorbus.proto import codec, fields
from factorbus.proto.budget import BUDGET_OPTION, BUDGET_SPAN_MS, BUDGET_WANTED
from factorbus.proto.closures import CLOSURE_POLICIES
from factorbus.proto.keep import KEEP_ALL, keep_text
from factorbus.proto.keys import checked_name
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.problems import BadMessage, Problem
from factorbus.solver.modes import MODES, mode_named
from factorbus.wording import counted


class OtherMode(Problem):
    """The map is there, in another mode than asked for."""

    code = "other_mode"

    def __init__(self, name: str, mode: str, wanted: str) -> None:
        super().__init__(f"map {name!r} is in mode {mode}, not {wanted}; join it as {mode} or drop it", mode=mode)


class OtherClosures(Problem):
    """The map is there, and treats loop closures otherwise than asked for."""

    code = "other_closures"

    def __init__(self, name: str, closures: str, wanted: str) -> None:
        super().__init__(
            f"map {name!r} has the policy {closures!r} for loop closures, not {wanted!r}, and keeps it; join it with "
            "that, or drop it",
            closures=closures,
        )


class OtherBudget(Problem):
    """The map is there, and its steps have another budget than asked for."""

    code = "other_budget"

    def __init__(self, name: str, budget_ms: float, wanted: float) -> None:
        has = f"a budget of {budget_ms:g} ms" if budget_ms else "no budget"
        super().__init__(
            f"the steps of map {name!r} have {has}, not {wanted:g} ms; join it with that, or change it first: "
            "admin/budget, `factorbus budget`",
            budget_ms=budget_ms,
        )


class OtherKeep(Problem):
    """The map is there, and keeps other poses than asked for."""

    code = "other_keep"

    def __init__(self, name: str, keep: str, wanted: str) -> None:
        super().__init__(
            f"map {name!r} keeps {keep!r}, not {wanted!r}, and stays so; join it with that, or drop it", keep=keep
        )


class NoBudget(Problem):
    """Steps of a map were to have a budget, in a mode in which they cannot have one."""

    code = "no_budget"

    def __init__(self, mode: str) -> None:
        super().__init__(
            f"steps in mode {mode} have no budget: they do all there is to do; leave out `budget_ms`, or make a map "
            "in mode bayes-tree",
            mode=mode,
        )


class MovedOn(Problem):
    """The map is not at the revision that the client who wants to drop it has in mind."""

    code = "moved_on"

    def __init__(self, name: str, revision: int, wanted: int, waiting: int) -> None:
        more = f" and {counted(waiting, 'insert')} under way" if waiting else ""
        super().__init__(
            f"map {name!r} is at revision {revision}{more}, not at {wanted}: it was not dropped; copy it again, or "
            "have its front ends leave first",
            revision=revision,
            waiting=waiting,
        )


class MapExists(Problem):
    """What is to be a new map has the name of one that is there."""

    code = "map_exists"

    def __init__(self, name: str, state: str = "open") -> None:
        what, way = f"a map {name!r} already", "drop it"
        if state != "open":
            what = f"a map {name!r} on disk, which does not open ({state})"
            way = f"`factorbus drop {name} --damaged` gives it up"
        super().__init__(f"there is {what}; {way}, or give the new one another name", map=name, state=state)


class NotDamaged(Problem):
    """A map that was to be given up for being damaged is open."""

    code = "not_damaged"

    def __init__(self, name: str) -> None:
        super().__init__(
            f"map {name!r} is open, so it is not damaged, and was not dropped; to drop an open map leave out `damaged`",
            map=name,
        )


class KeptElsewhere(Problem):
    """A fork would have a name that its service does not keep."""

    code = "kept_elsewhere"

    def __init__(self, name: str, pattern: str) -> None:
        super().__init__(
            f"a fork stays on the service of its original, which keeps maps named {pattern}; {name!r} is not one of "
            "them: give it such a name, or export and import the map",
            maps=pattern,
        )


class NotHere(Problem):
    """This service does not keep maps of that name."""

    code = "unknown_map"

    def __init__(self, name: str, pattern: str) -> None:
        super().__init__(f"this service keeps maps named {pattern}; {name!r} is not one of them", maps=pattern)


class Fork(NamedTuple):
    """Map `target` is to begin as map `source` is.  request: who asks again with the same one means the same fork."""

    source: str
    target: str
    request: int = 0


class MadeAs(NamedTuple):
    """How a map is made, or asked for.  mode None, closures "", budget_ms None, keep "": whichever, of a new one the
    service's.

    closures: its policy for loop closures.  budget_ms: of its steps; 0: they have no bound.  keep: which poses it
    keeps, as `keep_text` has it.
    """

    mode: str | None = None
    closures: str = ""
    budget_ms: float | None = None
    keep: str = ""


def read_create(payload: bytes) -> tuple[str, MadeAs]:
    """What an admin/create asks for: the map, and how it is to be.

    Raises BadMessage, BadOption, BadName, TooLarge.
    """
    content = codec.decode_map(payload, REQUEST_LIMITS, what="create")
    mode, closures = fields.choice_of("create", content, "mode", tuple(MODES), "auto"), ""
    if content.get("closures") is not None:
        closures = fields.choice_of("create", content, "closures", CLOSURE_POLICIES, "")
    budget_ms = None
    if content.get("budget_ms") is not None:
        budget_ms = fields.parameter("create", content, "budget_ms", BUDGET_SPAN_MS, BUDGET_WANTED, 0.0)
    keep = ""
    if content.get("keep") is not None:
        keep = keep_text(fields.text("create", content, "keep"), "create.keep")
    return _map_name(content, "create"), MadeAs(mode, closures, budget_ms, keep)


class Drop(NamedTuple):
    """Map `name` is to go: whatever revision it has, or only at this one; or only if it does not open (`damaged`)."""

    name: str
    revision: int | None = None
    damaged: bool = False


def read_drop(payload: bytes) -> Drop:
    """What an admin/drop asks for.  Raises BadMessage, BadName, TooLarge."""
    content = codec.decode_map(payload, REQUEST_LIMITS, what="drop")
    revision = fields.integer("drop", content, "revision") if content.get("revision") is not None else None
    damaged = fields.flag("drop", content, "damaged")
    if damaged and revision is not None:
        raise BadMessage("drop.revision", f"is {revision}", "none with `damaged`: what does not open has no revision")
    return Drop(_map_name(content, "drop"), revision, damaged)


class BudgetChange(NamedTuple):
    """The steps of map `name` are to have this budget; 0: no bound."""

    name: str
    budget_ms: float


def read_budget(payload: bytes) -> BudgetChange:
    """What an admin/budget asks for.  Raises BadMessage, BadOption, BadName, TooLarge."""
    content = codec.decode_map(payload, REQUEST_LIMITS, what="budget")
    name = _map_name(content, "budget")
    fields.number("budget", content, BUDGET_OPTION)  # has to be there: a field left out is not "none"
    return BudgetChange(name, fields.parameter("budget", content, BUDGET_OPTION, BUDGET_SPAN_MS, BUDGET_WANTED, 0.0))


def read_fork(payload: bytes) -> Fork:
    """What an admin/fork asks for.  Raises BadMessage, BadName, TooLarge."""
    content = codec.decode_map(payload, REQUEST_LIMITS, what="fork")
    request = fields.integer("fork", content, "request", default=0)
    return Fork(_map_name(content, "fork"), _map_name(content, "fork", "as"), request)


def check_made_as(name: str, made_as: MadeAs, asked: MadeAs) -> None:
    """Is map `name`, made so, as it is asked for?  Raises OtherMode, OtherClosures, OtherBudget, OtherKeep."""
    if asked.mode not in (None, made_as.mode):
        raise OtherMode(name, str(made_as.mode), asked.mode)
    if asked.closures not in ("", made_as.closures):
        raise OtherClosures(name, made_as.closures, asked.closures)
    if asked.budget_ms not in (None, made_as.budget_ms):
        raise OtherBudget(name, made_as.budget_ms or 0.0, asked.budget_ms)
    if asked.keep not in ("", made_as.keep):
        raise OtherKeep(name, made_as.keep, asked.keep)


def settled(asked: MadeAs, closures: str, budget_ms: float, keep: str = KEEP_ALL) -> MadeAs:
    """How a new map is made that is asked for so, by a service with these for new maps.  Raises NoBudget."""
    mode = settled_mode(asked.mode or "auto")
    check_budget(mode, asked.budget_ms)
    own = budget_ms if mode_named(mode).tree else 0.0
    return MadeAs(
        mode, asked.closures or closures, own if asked.budget_ms is None else asked.budget_ms, asked.keep or keep
    )


def check_budget(mode: str, budget_ms: float | None) -> None:
    """Can steps in `mode` have that budget?  Raises NoBudget."""
    if budget_ms and not mode_named(mode).tree:
        raise NoBudget(mode)


def settled_mode(mode: str) -> str:
    """What a map asked for in `mode` runs as."""
    return mode_named(mode).name


def ours(pattern: str, name: str) -> bool:
    """Does a service that keeps `pattern` (a name, or a beginning and *) keep `name`?"""
    return name.startswith(pattern[:-1]) if pattern.endswith("*") else name == pattern


def _map_name(content: dict, where: str, field: str = "map") -> str:
    return checked_name("map", fields.text(where, content, field))
