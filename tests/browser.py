"""A real browser for the tests: the system's Chromium, without a window, driven by Playwright."""

import io
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: apt-get install chromium")

# As root a sandbox cannot be made; the software renderer stands in for a graphics card.
_PATIENCE_MS = 120_000  # that renderer takes long where others work as well
_OPTIONS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@contextmanager
def page_of(url: str, width: int = 1200, height: int = 800, *, evaluates: bool = True) -> Iterator[Any]:
    """The page at `url`, in a browser of its own.

    evaluates: the test has the page evaluate text, which its own policy may forbid; False: the policy stands.
    """
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=_OPTIONS)
        try:
            page = browser.new_page(viewport={"width": width, "height": height}, bypass_csp=evaluates)
            page.set_default_timeout(_PATIENCE_MS)
            page.goto(url)
            yield page
        finally:
            browser.close()


def picture_of(page: Any) -> np.ndarray:
    """The page's pixels (height, width, 3), from 0 to 255."""
    from matplotlib.image import imread

    return (imread(io.BytesIO(page.screenshot()), format="png")[:, :, :3] * 255).round().astype(int)


def share_of(picture: np.ndarray, colour: str, within: int = 40) -> float:
    """The share of pixels of about that colour (#rrggbb)."""
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return float((np.abs(picture - wanted).max(axis=2) <= within).mean())


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
