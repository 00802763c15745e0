"""A question to every service there is: at a router there may be several, each with maps of its own."""

import time
from queue import SimpleQueue

from factorbus.client.link import Link
from factorbus.client.replies import NOBODY, Again, Reply, Silence, interpret_reply, why_silent
from factorbus.client.versions import refuse_other_protocol
from factorbus.proto import codec, keys
from factorbus.proto.problems import Problem, Unavailable


def query_all(link: Link, operation: str, timeout_s: float) -> list[bytes]:
    """What all who answer `admin/<operation>` say; asked again until somebody does.

    Raises Refused, Unavailable, OtherProtocol.
    """
    end = time.monotonic() + timeout_s
    key, payload, attempt = keys.admin_key(operation), codec.encode_map({}), 0
    what = f"the service, asked for admin/{operation},"
    link.check_open(what)
    while (left := end - time.monotonic()) > 0:
        attempt += 1
        came: SimpleQueue[list[Reply]] = SimpleQueue()
        link.ask_all(key, payload, left, came.put)
        verdicts = [interpret_reply(reply, attempt) for reply in came.get() or [Silence()]]
        if answers := [verdict for verdict in verdicts if isinstance(verdict, bytes)]:
            return answers
        link.check_open(what)
        for verdict in verdicts:
            if isinstance(verdict, Problem):
                raise verdict
        if attempt == 2 and all(isinstance(verdict, Again) for verdict in verdicts):
            refuse_other_protocol(link, max(end - time.monotonic(), 0.001))
        pauses = [verdict.pause_s for verdict in verdicts if isinstance(verdict, Again)]
        # No event tells that a service is free again: a busy one has said for how long it is, and we wait that long.
        time.sleep(min(max(pauses), max(end - time.monotonic(), 0.0)))
    raise Unavailable(what, timeout_s, f"{NOBODY}: {why_silent(key)}")
