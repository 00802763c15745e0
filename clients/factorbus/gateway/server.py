"""uvicorn on a thread of its own, at a port that is known before the first request."""

import asyncio
import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.protocol import State

# How long what is under way may take when the gateway stops; then connections are cut, and then tasks are cancelled.
_GRACE_S, _CUT_S = 2, 2


_BAD_REQUEST = b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


class _WebSocket(WebSocketsSansIOProtocol):
    """One that answers what is no upgrade, and can be stopped when it is being closed and the browser has not left."""

    def data_received(self, data: bytes) -> None:
        """As that of uvicorn, which neither answers nor closes what `websockets` cannot read, 129 headers for one."""
        super().data_received(data)
        if self.conn.handshake_exc is not None and not self.transport.is_closing():
            self.transport.write(_BAD_REQUEST)
            self.transport.close()

    def shutdown(self) -> None:
        """As that of uvicorn, which says farewell once more then, fails, and leaves the others open."""
        if self.conn.eof_sent or self.conn.state not in (State.CONNECTING, State.OPEN):
            self.transport.close()
        else:
            super().shutdown()


class _Server(uvicorn.Server):
    """One that stops, too, while a browser reads nothing of what was sent to it: its connection would never close."""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """As that of uvicorn."""
        cutting = asyncio.get_running_loop().call_later(_GRACE_S, self._cut)
        try:
            await super().shutdown(sockets)
        finally:
            cutting.cancel()

    def _cut(self) -> None:
        for connection in list(self.server_state.connections):
            connection.transport.abort()


def _without_trace(record: logging.LogRecord) -> bool:
    """A browser that sends text that is none is no fault of ours: the line says it, and the connection is closed."""
    if record.getMessage().startswith("Invalid UTF-8 sequence"):
        record.exc_info = None
    return True


@contextmanager
def serving(app: Starlette, host: str, port: int) -> Iterator[int]:
    """Serve `app` while inside; gives the port.  Raises OSError when it cannot listen there."""
    with socket.create_server((host, port), reuse_port=False) as listening:
        grace_s = _GRACE_S + _CUT_S
        config = uvicorn.Config(app, log_level="warning", ws=_WebSocket, timeout_graceful_shutdown=grace_s)
        logging.getLogger("uvicorn.error").addFilter(_without_trace)
        server = _Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, name="factorbus-gateway")
        thread.start()
        try:
            yield listening.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join()
