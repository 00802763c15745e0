"""A process that has everything imported and compiled, and forks services: so that many can be killed in a short time.

    python journal_nursery.py     reads `start ENDPOINT SETTINGS-AS-JSON`; prints `born PID`, `ready ENDPOINT`

It forks before anything of Zenoh is there; the children are services like any other, with a journal.
"""

import json
import logging
import os
import signal
import sys

from factorbus import idp, solver
from factorbus.proto.problems import Problem
from factorbus.service.app import serve
from factorbus.service.config import Config, checked_config
from factorbus.stopping import stop_on_signals


def main() -> None:
    """Fork a service for every line, until there are no more."""
    logging.basicConfig(level=logging.INFO, format="%(process)d %(message)s")
    solver.warm()
    idp.warm_idp()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for them
    say("nursery")
    for line in sys.stdin:
        word, *rest = line.split(maxsplit=2)
        if word == "quiet":
            say("quiet")
            continue
        endpoint, given = rest[0], json.loads(rest[1])
        if os.fork() == 0:
            os.close(0)
            say("born", os.getpid())  # before anything else it says, which a parent's word of it might come after
            run(checked_config(Config(**{"listen": (endpoint,), "warm": False, "create": ("m",), **given})))


def run(config: Config) -> None:
    """Serve until SIGTERM; never returns."""
    code = 0
    try:
        with stop_on_signals() as stop:
            serve(config, lambda endpoints: say("ready", *endpoints), stop)
    except Problem as problem:
        say("cannot", problem.code)
        logging.error("%s", problem)
        code = 2
    os._exit(code)


def say(*words: object) -> None:
    """A line in one piece, whatever its children say at the same time."""
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


if __name__ == "__main__":
    main()
