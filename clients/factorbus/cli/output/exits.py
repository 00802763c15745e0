"""How a command ends: the exit codes, the errors of the command line itself, and which error leads to which code."""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from factorbus.cli.output.console import document
from factorbus.cli.output.installing import install_command
from factorbus.proto.problems import Refused
from factorbus.wording.unreadable import is_device, mend_of

OK, FAILED, USAGE, BAD_FILE, UNAVAILABLE, REFUSED, INTERRUPTED = 0, 1, 2, 3, 4, 5, 130

EXIT_CODES = {
    OK: "done",
    FAILED: "failed: the message says at what",
    USAGE: "wrong use: an option, a name or an endpoint that cannot be",
    BAD_FILE: "an input file that cannot be read, or is not what it should be",
    UNAVAILABLE: "nobody answered: on the bus, or where a data set is fetched from",
    REFUSED: "refused, by the service, the solver or the command: the message says what, and why",
    INTERRUPTED: "interrupted",
}

# What the extras of pyproject.toml bring, by import name.
EXTRAS = {
    "service": ("numba", "llvmlite", "scipy", "prometheus_client"),
    "cholmod": ("sksparse",),
    "metis": ("pymetis",),
    "viz": ("matplotlib",),
    "watch": ("rerun",),
    "record": ("foxglove",),
    "gateway": ("starlette", "uvicorn", "websockets"),
    "ros2": ("rosbags", "xxhash", "mcap"),
}

_USAGE_CODES = (
    "bad_name", "bad_symbol", "bad_config", "bad_endpoint", "bad_option", "bad_people", "bad_picture", "bad_ros_name",
    "bad_setting", "cannot_listen", "exposed", "port_taken",
)  # fmt: skip
# Of what was typed, where the command itself finds it; a service says the same of what is in a file.
_TYPED_CODES = ("bad_information", "bad_loss", "bad_shape", "not_finite")
# Of what a command reads itself; a service refuses what needs a journal that it cannot read.
_READ_CODES = ("journal_unreadable",)
_UNAVAILABLE_CODES = ("unavailable", "shutting_down", "other_protocol")


class Stopped(Exception):
    """A command cannot go on.  `code` is for programs, the message says what to do next."""

    def __init__(self, code: str, message: str, exit_code: int = FAILED, **detail: Any) -> None:
        self.code, self.message, self.exit_code, self.detail = code, message, exit_code, detail
        super().__init__(message)


def report(error: Exception, as_json: bool, debug: bool) -> int:
    """Show `error` as one line on standard error (with `as_json`, also as the one document); returns the exit code."""
    code = str(getattr(error, "code", "failed"))
    message = str(getattr(error, "message", "") or error or type(error).__name__)
    if not hasattr(error, "code"):
        message = f"{type(error).__name__}: {message}" + ("" if debug else " (more with --debug)")
    if debug:
        click.echo("".join(traceback.format_exception(error)), err=True, nl=False)
    click.echo(f"factorbus: {message} [{code}]", err=True)
    if as_json:
        document({"problem": {"code": code, "message": message, "detail": getattr(error, "detail", {})}})
    return _exit_code(error, code)


@contextmanager
def input_file(path: Path) -> Iterator[None]:
    """Turns what goes wrong in reading `path` into the exit code for a bad file.  Raises Stopped."""
    if is_device(path):
        raise Stopped("bad_file", f"{path} cannot be read: it is a device; name a file", BAD_FILE, path=str(path))
    try:
        yield
    except UnicodeDecodeError as error:
        raise Stopped("bad_file", f"{path} is not text: {error.reason}", BAD_FILE, path=str(path)) from error
    except OSError as error:
        told = f"{path} cannot be read: {error.strerror}; {mend_of(error)}"
        raise Stopped("bad_file", told, BAD_FILE, path=str(path)) from error


@contextmanager
def output_file(path: Path) -> Iterator[None]:
    """Says of what goes wrong in writing `path` which file it was, and why.  Raises Stopped."""
    try:
        yield
    except OSError as error:
        told = f"{path} cannot be written: {error.strerror}; make room there, or name a file where this user may write"
        raise Stopped("cannot_write", told, path=str(path)) from error


def require(extra: str, what: str) -> None:
    """`what` needs the libraries of `extra`; said before the work begins, and with the command that installs them.

    Looks without importing.  Raises Stopped.
    """
    if missing := missing_modules(extra):
        raise Stopped(
            "missing_extra",
            f"{what} needs {', '.join(missing)}, not installed here: {install_command(extra)}",
            extra=extra,
        )


def missing_modules(extra: str) -> list[str]:
    """The libraries of `extra` that are not installed, by import name."""
    return [name for name in EXTRAS[extra] if find_spec(name) is None]


def _exit_code(error: Exception, code: str) -> int:
    if isinstance(error, Stopped):
        return error.exit_code
    if not hasattr(error, "code"):
        return FAILED
    if code == "bad_file" or (code in _READ_CODES and not isinstance(error, Refused)):
        return BAD_FILE
    if code in _USAGE_CODES or (code in _TYPED_CODES and not isinstance(error, Refused)):
        return USAGE
    if code in _UNAVAILABLE_CODES:
        return UNAVAILABLE
    return REFUSED
