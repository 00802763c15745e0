"""uvicorn on a thread of its own, at a port that is known before the first request."""

import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from starlette.applications import Starlette

_GRACE_S = 2


def _without_trace(record: logging.LogRecord) -> bool:
    """A browser that sends text that is none is no fault of ours: the line says it, and the connection is closed."""
    if record.getMessage().startswith("Invalid UTF-8 sequence"):
        record.exc_info = None
    return True


@contextmanager
def serving(app: Starlette, host: str, port: int) -> Iterator[int]:
    """Serve `app` while inside; gives the port.  Raises OSError when it cannot listen there."""
    with socket.create_server((host, port), reuse_port=False) as listening:
        config = uvicorn.Config(app, log_level="warning", ws="websockets-sansio", timeout_graceful_shutdown=_GRACE_S)
        logging.getLogger("uvicorn.error").addFilter(_without_trace)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, name="factorbus-gateway")
        thread.start()
        try:
            yield listening.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join()
