"""The page of a map that is edited, in a browser, as a hand uses it."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from browser import page_of


class EditedPage:
    """The page of a map, as a hand uses it."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.failures: list[str] = []
        page.on("pageerror", lambda error: self.failures.append(str(error)))

    def where(self, key: str, canvas: str = "#map") -> tuple[float, float]:
        """Of the window: where a variable is drawn."""
        of = "pixelOf" if canvas == "#map" else "pixelThere"
        self.page.wait_for_function(f"window.factorbus.{of}('{key}')")
        x, y = self.page.evaluate(f"window.factorbus.{of}('{key}')")
        box = self.page.locator(canvas).bounding_box()
        return box["x"] + x, box["y"] + y

    def click(self, key: str, canvas: str = "#map") -> None:
        self.page.mouse.click(*self.where(key, canvas))

    def click_between(self, first: str, second: str) -> None:
        """A factor, in its middle."""
        (ax, ay), (bx, by) = self.where(first), self.where(second)
        self.page.mouse.click((ax + bx) / 2, (ay + by) / 2)

    def press(self, text: str) -> None:
        """The button that says exactly so."""
        self.page.get_by_role("button", name=text, exact=True).click()

    def headed(self, text: str) -> str:
        """The panel, once its heading is this."""
        self.page.locator("#panel h2", has_text=text).wait_for()
        return self.page.inner_text("#panel")

    def notice(self, text: str) -> str:
        """What came of the last edit, once it has this in it."""
        self.page.locator("#notice", has_text=text).wait_for()
        return self.page.inner_text("#notice")


@contextmanager
def edited(address: str, name: str) -> Iterator[EditedPage]:
    with page_of(f"{address}/#{name}") as opened:
        page = EditedPage(opened)
        opened.wait_for_function("window.factorbus.session.token && window.factorbus.closures.revision > 0")
        yield page
        assert page.failures == []
