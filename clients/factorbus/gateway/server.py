"""uvicorn on a thread of its own, at a port that is known before the first request."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from starlette.applications import Starlette

_GRACE_S = 2


@contextmanager
def serving(app: Starlette, host: str, port: int) -> Iterator[int]:
    """Serve `app` while inside; gives the port.  Raises OSError when it cannot listen there."""
    with socket.create_server((host, port), reuse_port=False) as listening:
        server = uvicorn.Server(
            uvicorn.Config(app, log_level="warning", ws="websockets-sansio", timeout_graceful_shutdown=_GRACE_S)
        )
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, name="factorbus-gateway")
        thread.start()
        try:
            yield listening.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join()
