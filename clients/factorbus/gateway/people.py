"""Who asks, and what they may do: people with tokens, by role, as a file lists them.

    [operator]                  # may edit
    ann = "a text of sixteen characters or more that nobody guesses"

    [viewer]                    # looks
    wall = "another such text"

Reading asks nobody.  Without a token one has the role that the gateway gives to everybody who reaches it.
"""

import hmac
import re
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from factorbus.proto.problems import Problem

VIEWER, OPERATOR = "viewer", "operator"
_ROLES = (OPERATOR, VIEWER)
_NAME = re.compile(r"[A-Za-z0-9_]{1,24}")
_SHORTEST = 16  # characters of a token


class BadPeople(Problem):
    """A list of people that cannot be read."""

    code = "bad_people"

    def __init__(self, where: str, seen: str, wanted: str) -> None:
        super().__init__(f"{where}: {seen}; wanted {wanted}", where=where, seen=seen, wanted=wanted)


class NotAllowed(Problem):
    """Somebody asks the gateway for what they may not have done."""

    code = "not_allowed"


@dataclass(frozen=True, slots=True)
class Person:
    """name: as the journal has it, behind the gateway's own.  why: of a viewer, why they may not edit; in words."""

    name: str
    role: str
    why: str = ""


class People:
    """Persons by token.  usual: who somebody is without one."""

    def __init__(self, usual: Person, by_token: Iterable[tuple[str, Person]] = ()) -> None:
        self.usual = usual
        self._by_token = [(token.encode(), person) for token, person in by_token]

    @property
    def listed(self) -> list[Person]:
        """All who have a token."""
        return [person for _, person in self._by_token]

    def of(self, authorization: str | None) -> Person:
        """Who sends this header, `Bearer TOKEN`; None: it was not sent.  Raises NotAllowed."""
        if authorization is None:
            return self.usual
        scheme, _, token = authorization.partition(" ")
        given = token.strip().encode(errors="replace")
        found = [person for known, person in self._by_token if hmac.compare_digest(known, given)]
        if scheme.lower() != "bearer" or not found:
            raise NotAllowed(
                "the token is not one of those that this gateway knows; sign in with another one, or without"
                if self._by_token
                else "a token was given, and this gateway has no list of people (--people); sign out"
            )
        return found[0]


def read_people(text: str, where: str, usual: Person) -> People:
    """The people in a TOML document.  Raises BadPeople."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadPeople(where, f"it is not TOML ({error})", "tables of names and tokens by role") from None
    listed = list(_persons(content, where))
    for what, each in (("token", [t for t, _ in listed]), ("name", [p.name for _, p in listed])):
        if len(set(each)) < len(each):
            raise BadPeople(where, f"one {what} is there twice", f"a {what} of their own for each")
    return People(usual, listed)


def _persons(content: dict[str, Any], where: str) -> Iterator[tuple[str, Person]]:
    for role, names in content.items():
        if role not in _ROLES or not isinstance(names, dict):
            raise BadPeople(where, f"{role!r:.40} is no table of a role", "[operator] and [viewer]")
        for name, token in names.items():
            if not _NAME.fullmatch(name) or name == "local":
                wanted = "1 to 24 letters, digits and _; local is who has no token"
                raise BadPeople(f"{where}: [{role}]", f"the name {name!r:.40}", wanted)
            if not isinstance(token, str) or len(token) < _SHORTEST or not token.isascii() or not token.isprintable():
                wanted = f"{_SHORTEST} ASCII characters or more, such as `openssl rand -hex 16` prints"
                raise BadPeople(f"{where}: [{role}] {name}", "its token (not shown here)", wanted)
            why = "" if role == OPERATOR else f"{name} is a viewer in this gateway's list of people: viewers only look"
            yield token, Person(name, role, why)
