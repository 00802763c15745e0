"""The entry point: the table of commands, each imported when it is called, and how the process ends."""

import errno
import importlib
import io
import os
import re
import sys
from collections.abc import Sequence

import click

from factorbus.cli.output.console import document
from factorbus.cli.output.exits import BAD_FILE, EXIT_CODES, INTERRUPTED, OK, USAGE, Stopped, report
from factorbus.proto.nearest import nearest
from factorbus.proto.version import __version__
from factorbus.wording.unreadable import mend_of

# name -> (module, one line).  The lines stand here so that `factorbus --help` imports none of the commands.
COMMANDS = {
    "demo": ("demo", "A simulated robot drives: solver, workers, robot and viewer as processes."),
    "serve": ("serve", "Own maps and answer on the bus until stopped."),
    "work": ("work", "Join the bus as a worker and take jobs."),
    "replay": ("replay", "Drive a graph file (g2o, TORO, iSAM, SLAM++, pyfg, JRL) through a map, pose by pose."),
    "solve": ("solve", "Optimize a whole graph file: no map, no bus."),
    "simulate": ("simulate", "Write a simulated world to a file."),
    "watch": ("watch", "Watch a map live: in Rerun, in a browser, or into a recording."),
    "gateway": ("gateway", "Maps for browsers: a live page, HTTP and WebSocket."),
    "ros2": ("ros2", "Join a robot that speaks ROS 2 over Zenoh to a map."),
    "maps": ("maps", "The maps of a service: names, sizes, revisions."),
    "top": ("top", "Maps, clients and workers of a service, in the terminal."),
    "record": ("record", "Record a map into an MCAP file, which Foxglove opens."),
    "ask": ("ask", "How certain a map is, what it thinks of a measurement, and why."),
    "change": ("change", "Take something out of a map, count it differently, hold it; fork, merge."),
    "plot": ("plot", "Pictures: a map, a drive, the sparsity of its system, where things may be."),
    "save": ("save", "Write a map of a service into a file: g2o, pyfg, JRL, TUM or KITTI."),
    "convert": ("convert", "Turn one file format into another."),
    "datasets": ("datasets", "The public data sets: what there is, where it is, and fetching it."),
    "journal": ("journal", "What a service keeps on disk: show it, check it, run it again."),
    "export": ("export", "Copy a map out of a service's journal into one file."),
    "import": ("import_command", "Put an exported map into a service's journal."),
    "drop": ("drop", "Take a map off its service, if it is at the revision that was copied."),
    "budget": ("budget", "What a step of a map may take: set, change or remove it."),
    "warm": ("warm", "Compile the kernels ahead."),
    "access": ("access", "Write who may do what as a Zenoh configuration: TLS, users, access control."),
    "stats": ("stats", "What services count and time, asked over the bus."),
    "doctor": ("doctor", "Look for what is wrong on this machine, and say how to mend it."),
    "kinds": ("kinds", "The kinds of factors; what a formula of your own means, and whether it is right."),
    "explain": ("explain", "What an error code means, and what to do."),
    "bench": ("bench", "Measure, beside what it is held against."),
    "version": ("version", "The version, and those of the libraries."),
    "robot": ("robot", ""),
}
_HIDDEN = ("robot",)
_GROUPS = ("ask", "change", "plot", "journal", "datasets")  # commands that have commands
_NOT_REACHED = (errno.ENAMETOOLONG, errno.ELOOP, errno.EACCES, errno.EPERM)
_ROOM = "make room where it goes, or send it elsewhere"
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)

_EPILOG = """\b
Start here:
  factorbus demo                              what it looks like; the first time it compiles, 1 to 5 minutes
  factorbus replay my.g2o --plot map.png      the same with a file of your own
  factorbus serve                             then connect with ten lines of Python

\b
Exit codes:
"""


class _Commands(click.Group):
    """A group that knows the names and lines of its commands without importing them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [name for name in COMMANDS if name not in _HIDDEN]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        return importlib.import_module(f"factorbus.cli.commands.{COMMANDS[cmd_name][0]}").command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            within = " or ".join(f"`factorbus {group} {args[0]}`" for group in self._groups_with(ctx, args[0]))
            meant = f"; did you mean {within}?" if within else nearest(args[0], self.list_commands(ctx))
            ctx.fail(f"there is no command {args[0]!r}{meant or '; factorbus --help lists those there are'}")
        return super().resolve_command(ctx, args)

    def _groups_with(self, ctx: click.Context, name: str) -> list[str]:
        """Those commands that have one of this name among theirs, as `change` has `fork`."""
        groups = {group: self.get_command(ctx, group) for group in _GROUPS}
        return [group for group, found in groups.items() if isinstance(found, click.Group) and name in found.commands]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, COMMANDS[name][1]) for name in self.list_commands(ctx)])


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog=_EPILOG + "\n".join(f"  {code:<5}{meaning}" for code, meaning in EXIT_CODES.items()),
)
@click.version_option(__version__, prog_name="factorbus", message="%(prog)s %(version)s")
@click.option("--debug", is_flag=True, help="On an error, show the traceback too (or FACTORBUS_DEBUG=1).")
def cli(debug: bool) -> None:
    """A SLAM back end that robots talk to over a Zenoh message bus."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code, and never shows a traceback unless asked to."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    _print_what_can_be()
    as_json = "--json" in arguments[: arguments.index("--")] if "--" in arguments else "--json" in arguments
    debug = "--debug" in arguments or bool(os.environ.get("FACTORBUS_DEBUG"))
    try:
        return cli.main(arguments, prog_name="factorbus", standalone_mode=False) or OK
    except click.ClickException as error:
        error.show()
        if as_json:
            document({"problem": {"code": "bad_usage", "message": error.format_message(), "detail": _detail(error)}})
        if hint := _hint(error):
            click.echo(hint, err=True)
        click.echo("[bad_usage]", err=True)
        return USAGE
    except (KeyboardInterrupt, click.Abort):
        click.echo("interrupted", err=True)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output left, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return OK
    except OSError as error:
        if error.errno in _NOT_REACHED and error.filename is not None:  # by who only looked whether it is there
            told = f"{error.filename} cannot be read: {error.strerror}; {mend_of(error)}"
            return report(Stopped("bad_file", told, BAD_FILE, path=str(error.filename)), as_json, debug)
        if error.errno not in _FULL or error.filename is not None:
            return report(error, as_json=as_json, debug=debug)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return report(
            Stopped("cannot_write", f"standard output cannot be written: {error.strerror}; {_ROOM}"), False, debug
        )
    except Exception as error:
        return report(error, as_json=as_json, debug=debug)


def _detail(error: click.ClickException) -> dict[str, str | list[str]]:
    """What the text says beside the message: how the command is called, which there are, what was meant."""
    ctx = error.ctx if isinstance(error, click.UsageError) else None
    told: dict[str, str | list[str]] = {"usage": ctx.get_usage()} if ctx else {}
    if ctx and isinstance(ctx.command, click.Group):
        told["commands"] = ctx.command.list_commands(ctx)
    if isinstance(error, click.NoSuchOption) and error.possibilities:
        told["nearest"] = sorted(error.possibilities)
    if hint := _hint(error):
        told["hint"] = hint
    return told


def _hint(error: click.ClickException) -> str:
    """What was meant, where more is to be said than the names of near options and commands."""
    ctx = error.ctx if isinstance(error, click.UsageError) else None
    if ctx and ctx.parent and isinstance(ctx.command, click.Group) and "No such command" in error.message:
        there = ", ".join(ctx.command.list_commands(ctx))
        return f"The commands of `{ctx.command_path}` are: {there}. The name of a map or file comes behind one of them"
    if not isinstance(error, click.NoSuchOption):
        return ""
    if re.fullmatch(r"-[0-9.]", error.option_name):
        return "A number below 0 is written behind `--`, and options before that: NAME -- -1"
    if "topic" in error.option_name and error.ctx and error.ctx.info_name in ("replay", "ros2"):
        return (
            "Topics are named by their types: --odom, --landmarks, --pose-graph, --fix and others; "
            "`factorbus replay` finds what is not named, and says which topics it took"
        )
    return ""


def _print_what_can_be() -> None:
    """What the encoding of a stream does not have, χ in ASCII say, is shown as a question mark."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors in ("strict", "surrogateescape"):
            stream.reconfigure(errors="replace")
