"""Maps for browsers, which cannot speak Zenoh: a page that shows a map live, HTTP for questions, WebSockets for steps.

Who may edits maps there, by `Changes` as any client.  Needs the extra `gateway` (Starlette, uvicorn, websockets).
"""

from factorbus.gateway.app import make_app

__all__ = ["make_app"]
