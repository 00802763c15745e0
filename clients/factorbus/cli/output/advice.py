"""What to do next, in the words of the command line: a service and the client library advise programs."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from factorbus.cli.output.exits import REFUSED, Stopped
from factorbus.proto.problems import Problem

# What a message says to do begins behind one of these.
_MARKS = re.compile(r"(?<=nothing was merged\. )|(?<=nothing was attached\. )|(?<=; )")
_CHANGE = re.compile(r"^[a-z_]+: (?=there is no variable)")


def of_what_is_there(name: str) -> dict[str, str]:
    """For questions and changes that name what map `name` has not."""
    return {
        "unknown_variable": f"factorbus ask covariance {name} lists those there are",
        "unknown_factor": f"factorbus ask why {name} KEY lists those on a variable",
    }


MERGING = {
    "key_collision": "Give the variables of OTHER a letter of their own, such as --letter x=y",
    "no_anchor": "Give a relative pose between a pose of each map, that of OTHER under its new key "
    "(--anchor x5 y8 0,2,-1.57), or --frame; both with --sigmas",
    "kind_taken": "Give the kind of OTHER another name, such as --kind wheel=wheel_2",
    "absolute_factors": "--absolute leave-out merges it without them, --absolute keep as it is, if both have one frame",
}

ATTACHING = {"absolute_factors": "--absolute leave-out attaches the part without them"}


@contextmanager
def advising(advice: Mapping[str, str]) -> Iterator[None]:
    """Problems of these codes (code → what to do) end in that instead of their own.  Raises Stopped."""
    try:
        yield
    except Problem as problem:
        marks = list(_MARKS.finditer(problem.message))
        if problem.code not in advice or not marks:  # one without a mark, as of a map without a pose, advises nobody
            raise
        seen = problem.message[: marks[-1].end()]
        raise Stopped(problem.code, seen + advice[problem.code], REFUSED, **problem.detail) from problem


@contextmanager
def advising_changes(name: str) -> Iterator[None]:
    """The same for changes of map `name`, which are not called by their names on the wire.  Raises Stopped."""
    try:
        with advising(of_what_is_there(name)):
            yield
    except Stopped as stopped:
        told = _CHANGE.sub("", stopped.message)
        raise Stopped(stopped.code, told, stopped.exit_code, **stopped.detail) from stopped
