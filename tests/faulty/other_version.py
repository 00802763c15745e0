"""A service of another version of the protocol: all that we know of it is where its token is."""

from collections.abc import Iterator
from contextlib import contextmanager

import zenoh
from faulty.service import peer


@contextmanager
def someone_of(version: str, endpoint: str) -> Iterator[None]:
    """It listens at `endpoint` while inside."""
    with zenoh.open(peer(endpoint)) as session:
        token = session.liveliness().declare_token(f"factorbus/{version}/features/s/live")
        yield
        token.undeclare()
