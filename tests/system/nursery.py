"""A process that has everything imported and compiled, and forks workers: so that many can be killed in a short time.

    python nursery.py ENDPOINT        reads names, one a line; prints `ready`, then `born NAME PID` for each

It forks before anything of Zenoh is there; the children are workers like any other.
"""

import os
import signal
import sys
import threading

from factorbus import idp
from factorbus.proto.features import Shard
from factorbus.proto.features_codec import encode_ask, encode_shard
from factorbus.service.jobs.rates import example
from factorbus.workers import jobs
from factorbus.workers.app import work
from factorbus.workers.config import WorkerConfig


def main() -> None:
    """Fork a worker for every line, until there are no more."""
    idp.warm_idp()
    for form in ("rows", "half", "factored"):
        jobs.run_job("idp", encode_shard(Shard(encode_ask(example(form, 2)), 0, 2)))
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for them
    print("ready", flush=True)
    for line in sys.stdin:
        name = line.strip()
        pid = os.fork()
        if pid == 0:
            os.close(0)
            config = WorkerConfig((sys.argv[1],), name, slots=1, warm=False)
            work(config, lambda _: None, threading.Event())
            os._exit(0)
        print("born", name, pid, flush=True)


if __name__ == "__main__":
    main()
