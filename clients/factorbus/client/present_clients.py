"""Who has joined a map."""

from queue import SimpleQueue

from factorbus.client.link import Link
from factorbus.proto import keys


def present_clients(link: Link, map_name: str, timeout_s: float) -> set[str]:
    """Names of the clients whose tokens are there.  Raises Unavailable."""
    link.check_open(f"map {map_name!r}, asked for its clients")
    came: SimpleQueue[set[str]] = SimpleQueue()
    link.ask_tokens(keys.any_client_token(map_name), timeout_s, came.put)
    return set(map(keys.client_of, came.get()))
