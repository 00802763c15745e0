"""Editing in a real browser: what of the page's buttons `test_gateway_edit_page` does not press."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import needs_browser
from edited_page import edited
from gateways import square
from processes import Process

from factorbus.client import Bus, connect
from factorbus.proto.symbols import parse_symbol, symbol

pytest.importorskip("starlette")

pytestmark = needs_browser


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    with connect(endpoint, client="robot", timeout_s=60) as opened:
        yield opened


@pytest.fixture
def gateway(endpoint: str, spawn: Callable[..., Process]) -> str:
    (address,) = spawn("-m", "factorbus.cli", "gateway", "--connect", endpoint, "--port", "0").ready()
    return address


def test_a_factor_is_weighed_and_restored_and_a_pose_let_go_and_anchored(
    bus: Bus, gateway: str, tmp_path: Path
) -> None:
    with bus.map("weighed") as joined:
        joined.insert(square(false_closure=True), settle=True)
        with edited(gateway, "weighed") as page:
            before = joined.graph().batch.factor_count
            page.click_between("x2", "x10")
            page.headed("between_se2")
            heavy = factor_of(joined, "x2", "x10")
            page.page.fill("#weight", "1e-6")
            page.press("weigh")
            page.headed("Done")
            np.testing.assert_allclose(factor_of(joined, "x2", "x10"), 1e-6 * heavy, rtol=1e-9)
            assert joined.chi2().chi2 < 0.1
            # Rejected, and brought back out of the list, not by undo.
            page.click_between("x2", "x10")
            page.headed("between_se2")
            page.press("reject")
            page.headed("Done")
            assert joined.graph().batch.factor_count == before - 1
            page.press("restore")
            page.notice("restored")
            assert joined.graph().batch.factor_count == before
            page.page.locator("#edits h3", has_text="Rejected").wait_for(state="detached")
            # Held, and let go again.
            for button, fixed in (("hold", True), ("let go", False)):
                page.page.fill("#key", "x5")
                page.page.press("#key", "Enter")
                page.headed("x5")
                page.press(button)
                page.headed("Done")
                groups = joined.graph().batch.variables
                assert (symbol("x", 5) in [key for group in groups if group.fixed for key in group.keys]) is fixed
            # An anchor where one clicks: its place alone, with the sigma that one says.
            page.page.fill("#key", "x6")
            page.page.press("#key", "Enter")
            page.headed("x6")
            page.press("anchor")
            x, y = page.where("x6")
            scale = np.hypot(*np.subtract(page.where("x4"), (x, y))) / np.hypot(
                *np.subtract(joined.estimate["x4"][:2], joined.estimate["x6"][:2])
            )
            there = joined.estimate["x6"][:2] + np.array([30, 20]) / scale
            page.page.mouse.click(x + 30, y - 20)
            page.headed("x6 to (")
            page.page.fill("#sigma", "0.25")
            page.press("place the anchor")
            page.headed("Done")
            (anchor,) = (each for each in joined.graph().batch.factors if each.kind == "position_se2")
            assert anchor.keys.tolist() == [[symbol("x", 6)]]
            np.testing.assert_allclose(anchor.measured[0][:2], there, atol=0.02)
            np.testing.assert_allclose(anchor.information[0], [16.0, 0.0, 16.0])
            page.page.check("#labels")
            page.page.screenshot(path=tmp_path / "labels.png")  # for a person to look at


def factor_of(joined: Any, *keys: str) -> np.ndarray:
    """The information of the factor between these variables."""
    wanted = [parse_symbol(key) for key in keys]
    return next(
        group.information[group.keys.tolist().index(wanted)]
        for group in joined.graph().batch.factors
        if wanted in group.keys.tolist()
    )
