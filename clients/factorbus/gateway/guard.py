"""Which requests may change anything: sent by a page of ours, or by a program, in the name of who may edit.

A page of somebody else's can have a browser send us a request, with nothing but what a form can say.  So an edit needs
what a form cannot: its body as JSON, and a header with a text that only who may read our answers knows.
"""

import hmac
import json
import secrets
from typing import Any
from urllib.parse import urlsplit

from starlette.requests import Request

from factorbus.gateway.people import OPERATOR, NotAllowed, People, Person
from factorbus.proto.problems import BadMessage, TooLarge

FORM_HEADER = "x-factorbus-token"
_MOST_BYTES = 1 << 20


class Guard:
    """secret: what a page of ours sends with every edit, new with every start."""

    def __init__(self, people: People) -> None:
        self.people = people
        self.secret = secrets.token_urlsafe(24)

    def person(self, request: Request) -> Person:
        """Who asks.  Raises NotAllowed."""
        return self.people.of(request.headers.get("authorization"))

    def editor(self, request: Request) -> Person:
        """Who wants to edit, if they may and it is they who want it.  Raises NotAllowed."""
        headers = request.headers
        if not is_ours(headers.get("origin"), headers.get("host")) or _from_elsewhere(headers.get("sec-fetch-site")):
            raise NotAllowed("an edit was sent by a page that is not from here; nothing was changed")
        if not hmac.compare_digest(headers.get(FORM_HEADER, "").encode(), self.secret.encode()):
            raise NotAllowed(
                "an edit came without the token of this gateway's page, or with that of an earlier start; load the "
                f"page again; a program sends `token` of GET /api/maps/NAME/session as {FORM_HEADER}"
            )
        person = self.person(request)
        if person.role != OPERATOR:
            raise NotAllowed(f"{person.why}; nothing was changed")
        return person


def is_ours(origin: str | None, host: str | None) -> bool:
    """Whether a page from `origin`, if it is one, was fetched from here."""
    try:
        return origin is None or urlsplit(origin).netloc == host
    except ValueError:  # it is no address at all
        return False


async def read_body(request: Request) -> Any:
    """What a request says as JSON.  Raises BadMessage, TooLarge."""
    told = request.headers.get("content-type", "")
    if told.partition(";")[0].strip().lower() != "application/json":
        raise BadMessage("content-type", f"{told!r:.60}", "application/json")
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MOST_BYTES:
            raise TooLarge("the body", len(body), _MOST_BYTES, "bytes", "an edit is smaller")
    try:
        return json.loads(bytes(body), parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise BadMessage("the body", f"not JSON ({error})"[:120], 'JSON, such as {"edit": "reject", ...}') from None


def _no_number(text: str) -> Any:
    raise ValueError(f"{text} is no number of JSON")


def _from_elsewhere(site: str | None) -> bool:
    """By what a browser says of a request: of one that a page makes of its own gateway, same-origin."""
    return site not in (None, "same-origin", "none")
