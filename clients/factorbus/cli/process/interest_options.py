"""Options of commands that follow a part of a map."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import click

from factorbus.cli.process.options import WholeNumber

if TYPE_CHECKING:
    from factorbus.proto.interest import Interest

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class PartOptions:
    """Which part, and how fast; what was not given is None, or empty."""

    only: str
    kinds: tuple[str, ...]
    box: str
    period_ms: int | None
    bytes_per_s: int | None

    def interest(self) -> "Interest | None":
        """The interest; None: all of the map, as it goes.  Raises BadOption, UnknownKind."""
        from factorbus.proto.interest import Interest, checked_interest

        if not (self.only or self.kinds or self.box or self.period_ms or self.bytes_per_s):
            return None
        usual = Interest()
        return checked_interest(
            Interest(
                tuple(self.only),
                self.kinds,
                _numbers(self.box),
                self.period_ms or usual.period_ms,
                self.bytes_per_s or usual.bytes_per_s,
            )
        )


def part_options(command: F) -> F:
    """--only, --kind, --box, --period-ms, --bytes-per-s: the fields of PartOptions."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def _numbers(box: str) -> tuple[float, ...]:
    try:
        return tuple(float(each) for each in box.split(",")) if box else ()
    except ValueError:
        raise click.BadParameter(f"{box!r} is not 4 or 6 numbers with commas between", param_hint="--box") from None


_OPTIONS = (
    click.option(
        "--only", default="", metavar="LETTERS", help="Variables whose keys have one of these letters: x, or xl."
    ),
    click.option(
        "--kind", "kinds", multiple=True, metavar="KIND", help="Variables of this kind, such as se2; repeatable."
    ),
    click.option(
        "--box", default="", metavar="X,Y,X,Y", help="Variables in this box: the lowest x,y or x,y,z, then the highest."
    ),
    click.option(
        "--period-ms", type=WholeNumber(10, 60_000), metavar="MS", help="Merge changes for so long.  [default: 100]"
    ),
    click.option(
        "--bytes-per-s",
        type=WholeNumber(1000),
        metavar="N",
        help="Let the link carry this at most, newest poses first.",
    ),
)
