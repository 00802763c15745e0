"""The command of a benchmark that drives named data sets and prints a row for each solver."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

Rows = list[dict[str, Any]]


class DriveBench(NamedTuple):
    """name, about: of the command.  names: of the data sets.  looked_at, every: whose χ² at every N-th step.

    driven(data set, how many first steps, every): its rows.  missed(rows): the targets that they miss.
    """

    name: str
    about: str
    names: Sequence[str]
    looked_at: str
    every: int
    driven: Callable[[str, int | None, int], Rows]
    missed: Callable[[Rows], list[str]]


def print_rows(of: DriveBench) -> int:
    """Drive and print; the exit code is 1 when a target is missed."""
    parser = argparse.ArgumentParser(prog=f"factorbus bench {of.name}", description=of.about.splitlines()[0])
    parser.add_argument("--only", default=",".join(of.names), help="NAME,... of " + ", ".join(of.names))
    parser.add_argument("--every", type=int, default=of.every, help=f"look at {of.looked_at} at every N-th step")
    parser.add_argument("--steps", type=int, help="how many first steps; without, all")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    told, rows = parser.parse_args(), Rows()
    for name in told.only.split(","):
        made = of.driven(name, told.steps, told.every)
        rows += made
        for row in () if told.json else made:
            print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    missed = of.missed(rows)
    if told.json:
        print(json.dumps({"rows": rows, "missed": missed}))
    for each in missed:
        print(f"missed: {each}", file=sys.stderr)
    return 1 if missed else 0
