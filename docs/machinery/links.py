"""What in a built site leads nowhere, or would be fetched from elsewhere when a page is looked at."""

from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

# tag → the attribute that names what the browser fetches by itself.
_FETCHED = {"img": "src", "script": "src", "iframe": "src", "source": "src", "link": "href"}
_NEVER_FETCHED = {"canonical", "next", "prev", "index", "search", "alternate"}


class _Page(HTMLParser):
    """The anchors of a page, where its links lead, and what it fetches."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Called for each tag."""
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if (name := _FETCHED.get(tag, "")) in given and given.get("rel", "") not in _NEVER_FETCHED:
            self.fetched.append(given[name])


def broken(site: Path) -> Iterator[str]:
    """One line for each link to a page or anchor that there is not, and for each thing fetched from elsewhere."""
    pages = {path: _Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    for path, page in pages.items():
        name = path.relative_to(site)
        for address in page.fetched:
            if urlsplit(address).netloc:
                yield f"{name}: {address} would be fetched from elsewhere"
        for address in page.links + page.fetched:
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.is_file():
                yield f"{name}: {address} leads to no file"
            elif parts.fragment and target.suffix == ".html" and unquote(parts.fragment) not in pages[target].anchors:
                yield f"{name}: {address} leads to no place on that page"
