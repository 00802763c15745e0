"""`python -m factorbus.service`: a service in the foreground, for tests, containers and service managers."""

import argparse
import logging
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from factorbus.ownership import UnsafeFolder
from factorbus.proto.closures import CLOSURE_POLICIES
from factorbus.proto.problems import Problem
from factorbus.service.config import DURABILITIES, Config, checked_config, load_config
from factorbus.stopping import stop_on_signals


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until SIGTERM or SIGINT.  Prints `ready ENDPOINT ...` when clients can connect; 2: cannot start."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    with stop_on_signals() as stop:
        from factorbus.service.app import serve

        try:
            serve(_config(options), lambda endpoints: print("ready", *endpoints, flush=True), stop)
        except (Problem, UnsafeFolder, OSError) as problem:
            print(f"factorbus: {problem}", file=sys.stderr)
            return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m factorbus.service", description="Keep maps and answer for them.")
    parser.add_argument("--config", metavar="FILE", help="settings as TOML; what is given here wins")
    parser.add_argument("--listen", action="append", metavar="ENDPOINT", help="such as tcp/127.0.0.1:7447; port 0: any")
    parser.add_argument("--connect", action="append", metavar="ENDPOINT", help="a router to meet clients at")
    parser.add_argument("--mode", choices=("peer", "router", "client"))
    parser.add_argument("--name", help="of this service, in its liveliness tokens")
    parser.add_argument("--maps", metavar="PATTERN", help="the maps it answers for: a name or a beginning and *")
    parser.add_argument("--zenoh", metavar="FILE", help="Zenoh configuration: TLS, users, access control")
    parser.add_argument("--insecure", action="store_true", help="listen to other machines even without these")
    parser.add_argument("--create", action="append", metavar="MAP", help="a map to have from the start")
    parser.add_argument("--journal", metavar="DIR", help="keep maps here, across restarts and crashes")
    parser.add_argument("--durability", choices=DURABILITIES, help="what an answer promises: see service/README.md")
    parser.add_argument("--closures", choices=CLOSURE_POLICIES, help="of new maps: believe loop closures, or test them")
    parser.add_argument("--budget-ms", type=float, metavar="MS", help="of new maps: what a step may take; 0: no bound")
    parser.add_argument("--keep", metavar="POLICY", help="of new maps: poses to keep, such as per_area=2,window=50")
    parser.add_argument("--standby", action="store_true", help="wait until the journal's owner is gone, and take over")
    parser.add_argument("--upstream", metavar="ENDPOINT", help="be a replica of the service there")
    parser.add_argument("--upstream-zenoh", metavar="FILE", help="Zenoh configuration of the session with it")
    parser.add_argument("--no-warm", action="store_true", help="compile kernels when they are first used")
    return parser


def _config(options: argparse.Namespace) -> Config:
    given: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name in (
            "listen",
            "connect",
            "mode",
            "name",
            "maps",
            "create",
            "zenoh",
            "journal",
            "durability",
            "closures",
            "budget_ms",
            "keep",
            "upstream",
            "upstream_zenoh",
        )
        if (value := getattr(options, name)) is not None
    }
    if options.no_warm:
        given["warm"] = False
    if options.standby:
        given["standby"] = True
    if options.insecure:
        given["insecure"] = True
    return load_config(options.config, **given) if options.config else checked_config(replace(Config(), **given))


if __name__ == "__main__":
    sys.exit(main())
