"""Is it silence, or a service of another major version of the protocol?  Every service has a token."""

from queue import SimpleQueue

from factorbus.client.link import Link
from factorbus.proto import keys
from factorbus.proto.problems import OtherProtocol

LOOK_S = 1.0


def other_protocol(versions: set[str]) -> OtherProtocol | None:
    """What to say of `versions` of services that are there; None: one is ours, or nobody is there at all."""
    return OtherProtocol(sorted(versions), keys.VERSION) if versions and keys.VERSION not in versions else None


def refuse_other_protocol(link: Link, timeout_s: float) -> None:
    """Look who is there, and wait for it.  Raises OtherProtocol if nobody who is speaks our version."""
    came: SimpleQueue[set[str]] = SimpleQueue()
    link.ask_versions(min(timeout_s, LOOK_S), came.put)
    if (other := other_protocol(came.get())) is not None:
        raise other
