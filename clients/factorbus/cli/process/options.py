"""Options that several commands have."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar, cast

import click

F = TypeVar("F", bound=Callable[..., Any])

# Where a service listens, and where clients look for one, without an address of their own.
USUAL_ENDPOINT = "tcp/127.0.0.1:7447"
DEFAULT_ENDPOINT = os.environ.get("FACTORBUS_ENDPOINT") or USUAL_ENDPOINT
PAGE_HOST = "127.0.0.1"  # where a page for browsers is served, without an address of its own
# Who reads or writes a path says what is wrong with it, with the exit code of that: click's own would say wrong use.
PATH = click.Path(path_type=Path, readable=False)
FOLDER = click.Path(path_type=Path, readable=False, file_okay=False)
# The solver's modes; `tests/clients/test_cli.py` holds them to its own list, which this end does not import.
MODES = ("auto", "inc-l", "inc-l-b10", "inc-l-b100", "all-batch", "bayes-tree")
# The endings of pictures; `tests/clients/test_cli_files.py` holds them to those of `factorbus.viz`.
PICTURES = (".png", ".svg", ".pdf")
WORLDS = ("manhattan", "city-trees", "sphere")


def grouped(name: str, group: type) -> Callable[[F], F]:
    """Options that belong together reach the command as one argument `name`: a `group`, a dataclass of their names."""
    own = [field.name for field in fields(group)]

    def with_group(command: F) -> F:
        @wraps(command)
        def call(*args: Any, **given: Any) -> Any:
            return command(*args, **{name: group(**{each: given.pop(each) for each in own})}, **given)

        return cast(F, call)

    return with_group


class ModeChoice(click.Choice):
    """One of MODES; the paper's spelling "inc-l b10" is taken too."""

    def __init__(self) -> None:
        super().__init__(MODES)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return super().convert(str(value).replace(" ", "-"), param, ctx)


def mode_option(command: F) -> F:
    """--mode."""
    return click.option(
        "--mode",
        type=ModeChoice(),
        default="auto",
        show_default=True,
        help="How the map is solved. bayes-tree, which auto is: a step eliminates what it affects, in a tree of "
        "cliques. inc-l: R is updated; inc-l-b10, inc-l-b100: with a batch step every 10 or 100 variables alone. "
        "all-batch: every step factorizes anew.",
    )(command)


class WholeNumber(click.IntRange):
    """A whole number in a range; of what is none click's own says that it is no valid integer range."""

    name = "integer"


class Number(click.FloatRange):
    """A finite number in a range: click's own lets NaN through, and calls what is no number no valid float range."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


# Seconds to wait for something: a day at most, which the operating system's clocks can count.
SECONDS = Number(0, 86400)


def connect_option(command: F) -> F:
    """--connect, of a service that runs."""
    return click.option(
        "--connect", "endpoint", default=DEFAULT_ENDPOINT, show_default=True, metavar="ENDPOINT", help="The service."
    )(command)


def timeout_option(default_s: float) -> Callable[[F], F]:
    """--timeout: the same word, for the same, in every command that waits for an answer."""
    return click.option(
        "--timeout",
        "timeout_s",
        type=SECONDS,
        default=default_s,
        show_default=True,
        metavar="S",
        help="Give up after S seconds without an answer.",
    )


def zenoh_option(command: F) -> F:
    """--zenoh."""
    return click.option(
        "--zenoh",
        default="",
        envvar="ZENOH_CONFIG",
        metavar="FILE.json5",
        help="Zenoh configuration with our certificate or password.  [env: ZENOH_CONFIG]",
    )(command)


def json_option(command: F) -> F:
    """--json."""
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")(command)


@dataclass(frozen=True, slots=True)
class MapAddress:
    """A map on the bus: its name, the service that has it, our Zenoh configuration, seconds to wait for an answer."""

    name: str
    endpoint: str
    zenoh: str
    timeout_s: float


def asks_map(command: F) -> F:
    """NAME, --connect, --timeout and --zenoh, as one argument `address`, and --json: of a command that asks a map."""
    address = grouped("address", MapAddress)
    for option in (address, json_option, zenoh_option, timeout_option(30), connect_option, click.argument("name")):
        command = option(command)
    return command


def file_argument(name: str) -> Callable[[F], F]:
    """A path that is checked by who reads it, so that a bad one has the exit code of a bad file."""
    return click.argument(name, type=PATH)


def out_option(flag: str, name: str, text: str, metavar: str) -> Callable[[F], F]:
    """An option that names a file to write; its folder must exist, which is said before the work and not after.

    metavar: with an ending, FILE.g2o, or several, FILE.g2o|.pyfg, they are the file's too; of a picture any of PICTURES
    will do.
    """
    named = tuple(filter(None, (Path(f"_{each}").suffix for each in metavar.split("|"))))
    endings = PICTURES if set(named) & set(PICTURES) else named

    def checked(ctx: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
        ending = "" if path is None else path.suffix.lower() if endings is PICTURES else path.suffix
        if path is not None and endings and ending not in endings:
            raise click.BadParameter(f"{path} does not end in {' or '.join(endings)}", param=parameter)
        return checked_output(ctx, parameter, path)

    return click.option(flag, name, type=PATH, callback=checked, metavar=metavar, help=text)


def checked_output(_ctx: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    """A file that can be written, as far as that is to be known beforehand."""
    try:
        return _checked_output(parameter, path)
    except OSError as error:  # such as a name that is too long
        raise click.BadParameter(f"{path} cannot be written: {error.strerror}", param=parameter) from error


def _checked_output(parameter: click.Parameter, path: Path | None) -> Path | None:
    if path is not None and not path.absolute().parent.is_dir():
        raise click.BadParameter(f"there is no folder {path.parent}; make it first", param=parameter)
    if path is not None and path.is_dir():
        raise click.BadParameter(f"{path} is a folder; wanted the name of a file", param=parameter)
    if path is not None and not os.access(path if path.exists() else path.absolute().parent, os.W_OK):
        raise click.BadParameter(f"{path} cannot be written: permission denied", param=parameter)
    return path


def ellipses_option(count: int) -> Callable[[F], F]:
    """--ellipses."""
    return click.option(
        "--ellipses",
        type=WholeNumber(0, 2000),
        default=count,
        show_default=True,
        metavar="N",
        help="Draw 95 % ellipses of up to N poses and N points.",
    )


def journal_option(command: F) -> F:
    """--journal, of commands that read or write a folder of journals themselves."""
    return click.option(
        "--journal",
        "folder",
        type=PATH,
        required=True,
        metavar="DIR",
        help="The folder that `factorbus serve` has.",
    )(command)
