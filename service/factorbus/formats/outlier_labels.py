"""Which measurements of a JRL file are labelled: lists of [entry, measurement], for each robot.

Files have them in several forms:

    {"a": [[0, 2], ...], "b": [...]}         as JRL's parser takes them
    [["a", [[0, 2], ...]], [98, [...]]]      a list for each robot beside its letter or code
    [[[0, 2], ...], [...]]                   a list for each of `robots`, in their order
    [[0, 2], ...]                            as JRL's documents have it: no robot is named

Of several robots the last form says whose a measurement is only where one robot alone has one of these numbers.  Where
others have it too, nobody knows: the labels are left out and that is said; the graph is the same with and without.
"""

from collections.abc import Iterator, Mapping

from factorbus.formats.json_parts import Part, abridged
from factorbus.formats.left_out import LeftOut
from factorbus.proto.stamps import MOST_STAMP

POTENTIAL_OUTLIERS, OUTLIERS = "potential_outlier_factors", "outlier_factors"
_NOUNS = {POTENTIAL_OUTLIERS: "potential outliers", OUTLIERS: "outliers"}
_PAIR = 2


def robots_in(part: Part | None) -> Iterator[tuple[str, Part]]:
    """The members of an object that has one for each robot.  Raises FormatError."""
    for letter, of in (part.members() if part else {}).items():
        if len(letter) != 1 or not letter.isascii():
            raise of.refused("robots that are a letter each", f"the robot {abridged(letter)!r}")
        yield letter, of


def listed(part: Part | None) -> list[Part]:
    """What is in an array; nothing where there is none: programs of JRL write null for an empty one."""
    return [] if part is None or part.value is None else part.items()


def labelled_factors(
    document: Part, name: str, sizes: Mapping[tuple[str, int], int], left: LeftOut
) -> set[tuple[str, int, int]]:
    """(robot, entry, measurement) of what is in the labels of that name.  Raises FormatError.

    sizes: how many measurements there are, by robot and entry.
    """
    part = document.find(name)
    if part is None:
        return set()
    if not isinstance(part.value, list):
        lists = list(robots_in(part))
    elif (named := _by_robot(document, part)) is not None:
        lists = named
    else:
        return _of_nobody(part, name, sizes, left)
    return {(robot, *_pair(each, {robot}, sizes)) for robot, of in lists for each in listed(of)}


def _by_robot(document: Part, part: Part) -> list[tuple[str, Part]] | None:
    """The lists of an array that has one for each robot; None: it has none.  Raises FormatError."""
    items = part.items()
    if not items or not all(isinstance(item.value, list | None) for item in items):
        return None
    if all(isinstance(item.value, list) and _is_named(item.value) for item in items):
        return [(_letter(pair[0]), pair[1]) for pair in (item.items() for item in items)]
    if all(isinstance(inner, list) for item in items for inner in item.value or []):
        letters = [_letter(robot) for robot in listed(document.find("robots"))]
        if len(letters) != len(items):
            raise part.refused(f"an array for each of {len(letters)} robots", f"an array of {len(items)}")
        return list(zip(letters, items, strict=True))
    return None


def _is_named(value: list[object]) -> bool:
    return len(value) == _PAIR and isinstance(value[0], int | str) and isinstance(value[1], list | None)


def _letter(part: Part) -> str:
    """A robot by its letter, or the code of it.  Raises FormatError."""
    if isinstance(part.value, str) and len(part.value) == 1 and part.value.isascii():
        return part.value
    return chr(part.whole(0, 127))


def _of_nobody(part: Part, name: str, sizes: Mapping[tuple[str, int], int], left: LeftOut) -> set[tuple[str, int, int]]:
    """Labels that name no robot."""
    robots = {robot for robot, _ in sizes}
    found = set()
    for each in part.items():
        at, number = _pair(each, robots, sizes)
        owners = [robot for robot in robots if number < sizes.get((robot, at), 0)]
        if len(owners) > 1:
            why = "they are an array that names no robot, and several robots have such measurements"
            left.drop(_NOUNS[name], len(part.value), why)
            return set()
        found.add((owners[0], at, number))
    return found


def _pair(part: Part, robots: set[str], sizes: Mapping[tuple[str, int], int]) -> tuple[int, int]:
    """(entry, measurement) of what one of these robots has.  Raises FormatError."""
    ends = part.items()
    if len(ends) != _PAIR:
        raise part.refused("[entry, measurement]", f"an array of {len(ends)}")
    at, number = (end.whole(0, MOST_STAMP) for end in ends)
    if not any(number < sizes.get((robot, at), 0) for robot in robots):
        raise part.refused("[entry, measurement]", f"measurement {number} of entry {at}, which is not there")
    return at, number
