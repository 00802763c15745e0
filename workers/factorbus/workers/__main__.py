"""`python -m factorbus.workers`: a worker in the foreground, for tests, containers and service managers."""

import argparse
import logging
import sys
from collections.abc import Sequence

from factorbus.ownership import UnsafeFolder
from factorbus.proto.problems import Problem
from factorbus.stopping import stop_on_signals
from factorbus.workers.config import WorkerConfig, checked_worker_config


def main(arguments: Sequence[str] | None = None) -> int:
    """Work until SIGTERM or SIGINT.  Prints `ready NAME` when jobs are taken; 2: cannot start."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    with stop_on_signals() as stop:
        from factorbus.workers.app import work

        try:
            work(_config(options), lambda name: print("ready", name, flush=True), stop)
        except (Problem, UnsafeFolder, OSError) as problem:
            print(f"factorbus: {problem}", file=sys.stderr)
            return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m factorbus.workers", description="Take jobs from services.")
    parser.add_argument("--connect", action="append", metavar="ENDPOINT", help="a service, or a router")
    parser.add_argument("--name", default="", help="in its keys; made up by default")
    parser.add_argument("--slots", type=int, default=1, help="jobs at a time")
    parser.add_argument("--zenoh", default="", metavar="FILE", help="Zenoh configuration: TLS, access control")
    parser.add_argument("--no-warm", action="store_true", help="compile kernels when they are first used")
    return parser


def _config(options: argparse.Namespace) -> WorkerConfig:
    connect = tuple(options.connect) if options.connect else WorkerConfig().connect
    return checked_worker_config(WorkerConfig(connect, options.name, options.slots, options.zenoh, not options.no_warm))


if __name__ == "__main__":
    sys.exit(main())
