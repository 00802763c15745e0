"""Editing in a real browser, by clicks: a closure goes and comes back, a pose is dragged, two maps become one."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import needs_browser, page_of
from edited_page import edited
from gateways import Editor, arc, square
from processes import Process

from factorbus.client import Bus, Changes, Draft, connect

pytest.importorskip("starlette")

pytestmark = needs_browser
ANN, WALL = "the-token-of-an-operator", "the-token-of-a-viewer"


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    with connect(endpoint, client="robot", timeout_s=60) as opened:
        yield opened


@pytest.fixture
def gateway(endpoint: str, spawn: Callable[..., Process]) -> str:
    (address,) = spawn("-m", "factorbus.cli", "gateway", "--connect", endpoint, "--port", "0").ready()
    return address


def test_a_closure_is_rejected_and_undone_by_clicks(bus: Bus, gateway: str, tmp_path: Path) -> None:
    with bus.map("clicked") as joined:
        joined.insert(square(false_closure=True), settle=True)
        factors, chi2 = joined.graph().batch.factor_count, joined.chi2().chi2
        with edited(gateway, "clicked") as page:
            page.click_between("x2", "x10")
            said = page.headed("between_se2")
            assert "x2, x10" in said
            for what in ("residual", "χ²", "misfit", "weight", "σ of it", "not by an edit here"):
                assert what in said
            page.press("reject")
            assert "rejected between_se2 (x2, x10), by local" in page.headed("Done")
            assert joined.graph().batch.factor_count == factors - 1
            assert joined.chi2().chi2 < 1e-6
            page.page.locator("#edits", has_text="Rejected").wait_for()
            page.press("undo 1: rejected between_se2 (x2, x10), by local")
            page.headed("Undone")
            assert joined.graph().batch.factor_count == factors
            assert joined.chi2().chi2 == pytest.approx(chi2, rel=1e-6)
            page.page.locator("#edits li.undone").wait_for()
            page.page.screenshot(path=tmp_path / "undone.png")  # for a person to look at


def test_a_closure_that_is_not_believed_is_seen_and_accepted_by_clicks(bus: Bus, gateway: str, tmp_path: Path) -> None:
    with bus.map("doubted", closures="test") as joined:
        joined.insert(square(false_closure=True), settle=True)
        with edited(gateway, "doubted") as page:
            page.page.wait_for_function("window.factorbus.suspects.closures.length === 1")
            page.page.screenshot(path=tmp_path / "suspect.png")  # for a person to look at
            page.click_between("x2", "x10")
            said = page.headed("closure 17")
            for what in ("x2, x10", "suspect", "improbable", "d²", "chance"):
                assert what in said
            page.press("accept")
            assert "accepted closure 17, by local" in page.headed("Done")
            assert joined.suspects().factors.tolist() == []
            page.page.wait_for_function("window.factorbus.suspects.closures.length === 0")
            page.press("undo 1: accepted closure 17, by local")
            page.headed("Undone")
            page.page.wait_for_function("window.factorbus.suspects.closures[0]?.state === 'rejected'")


def test_a_pose_is_dragged_held_anchored_and_found_by_its_key(bus: Bus, gateway: str) -> None:
    with bus.map("dragged") as joined:
        joined.insert(arc())
        before = joined.estimate["x10"][:2].copy()
        with edited(gateway, "dragged") as page:
            page.page.fill("#key", "x10")
            page.page.press("#key", "Enter")
            page.headed("x10")
            page.press("drag")
            x, y = page.where("x10")
            page.page.mouse.move(x, y)
            page.page.mouse.down()
            page.page.mouse.move(x + 40, y - 30, steps=4)
            page.page.mouse.up()
            assert "A prior says that it is there" in page.headed("x10 to (")
            assert joined.graph().batch.factor_count == 11, "nothing is sent before it is confirmed"
            page.page.fill("#sigma", "no number")
            page.press("put it there")
            page.notice("wanted a number above 0")
            assert joined.graph().batch.factor_count == 11
            page.page.fill("#sigma", "0.01")
            page.press("put it there")
            page.headed("Done")
            prior = next(group for group in joined.graph().batch.factors if group.kind == "prior_se2")
            moved = prior.measured[0][:2] - before
            assert moved[0] > 0.1
            assert moved[0] / moved[1] == pytest.approx(40 / 30, rel=0.05)
            # Several with shift, and held together.
            page.press("show all")
            page.click("x4")
            page.headed("x4")
            page.page.keyboard.down("Shift")
            page.click("x6")
            page.page.keyboard.up("Shift")
            page.headed("2 selected")
            page.press("hold 2 variables")
            page.notice("held x4, x6")
            # An anchor at the point clicked, cancelled.
            page.click("x2")
            page.headed("x2")
            page.press("anchor")
            x, y = page.where("x2")
            page.page.mouse.click(x + 30, y + 20)
            page.headed("x2 to (")
            page.press("cancel")
            assert joined.graph().batch.factor_count == 12


def test_two_maps_are_merged_by_clicking_pairs(bus: Bus, gateway: str, tmp_path: Path) -> None:
    with bus.map("first") as first, bus.map("second") as second:
        first.insert(square(), settle=True)
        second.insert(square(), settle=True)
        with edited(gateway, "first") as page:
            page.press("merge a map")
            page.page.select_option("#beside", "second")
            page.press("open beside")
            for here, there in (("x5", "x13"), ("x10", "x2"), ("x14", "x6")):
                page.click(here)
                page.notice(f"{here} here")
                page.click(there, "#other")
                page.page.locator("#panel li", has_text=f"{here} is {there} of second").wait_for()
            page.page.screenshot(path=tmp_path / "pairs.png")  # for a person to look at
            page.press("merge second by 3 pairs")
            said = page.headed("merged map second by 3 pairs")
            assert "17 variables and 20 factors came in" in said
            assert "x is a" in said
            assert "contradicts" not in said
            assert first.graph().batch.variable_count == 34
            first.estimate.wait_for(int(first.stats()["revision"]))
            np.testing.assert_allclose(first.estimate["a2"][:2], first.estimate["x10"][:2], atol=0.01)
            assert page.page.locator("#other").is_hidden()
            page.press("undo 1: merged map second by 3 pairs, by local")
            page.headed("Undone")
            assert first.graph().batch.variable_count == 17


def test_what_the_service_refuses_is_said_with_its_code(bus: Bus, gateway: str) -> None:
    with bus.map("held") as joined:
        chain = Draft().se2("x0", (0, 0, 0), fixed=True).se2("x1")
        joined.insert(chain.between_se2("x0", "x1", (1, 0, 0), sigmas=(0.1, 0.1, 0.1)))
        with edited(gateway, "held") as page:
            page.click_between("x0", "x1")
            page.headed("between_se2")
            page.press("reject")
            said = page.notice("[underconstrained]")
            assert said.startswith("Nothing was changed: nothing holds x1")
            assert page.page.locator("#edits li").count() == 0
        assert joined.graph().batch.factor_count == 1


def test_a_viewer_is_told_why_and_has_no_buttons(
    bus: Bus, endpoint: str, spawn: Callable[..., Process], tmp_path: Path
) -> None:
    (tmp_path / "people.toml").write_text(f'[operator]\nann = "{ANN}"\n[viewer]\nwall = "{WALL}"\n')
    asked = ("--connect", endpoint, "--port", "0", "--people", str(tmp_path / "people.toml"))
    (address,) = spawn("-m", "factorbus.cli", "gateway", *asked).ready()
    with bus.map("looked") as joined:
        joined.insert(arc())
        with edited(address, "looked") as page:
            role = page.page.locator("#role")
            role.get_by_text("sign in with your token").wait_for()
            page.page.fill("#token", WALL)
            page.press("sign in")
            role.get_by_text("looking only: wall is a viewer in this gateway's list of people").wait_for()
            for name in ("#undo", "#merge"):
                assert page.page.locator(name).is_hidden()
            page.click("x4")
            page.headed("x4")
            page.click_between("x4", "x5")
            page.headed("between_se2")
            assert page.page.locator("#panel button:not(.link)").count() == 0
            page.page.screenshot(path=tmp_path / "viewer.png")  # for a person to look at
            page.press("sign out")
            page.page.fill("#token", ANN)
            page.press("sign in")
            role.get_by_text("editing as ann").wait_for()
            page.click("x4")
            page.headed("x4")
            page.press("hold")
            page.notice("held x4")
            page.page.locator("#edits", has_text="held x4, by ann").wait_for()


def test_the_page_runs_under_its_own_policy_and_shows_names_as_text(bus: Bus, gateway: str) -> None:
    """No script but ours, no style in the text; and what is typed or said is never HTML."""
    with bus.map("strict") as joined:
        joined.insert(square())
    with page_of(gateway, evaluates=False) as page:
        complaints: list[str] = []
        page.on("console", lambda message: complaints.append(message.text))
        page.goto(f"{gateway}/#strict")
        page.locator("#state", has_text="17 variables").wait_for()
        page.fill("#key", "<img src=x onerror=document.title='hit'>")
        page.press("#key", "Enter")
        page.locator("#notice", has_text="There is no <img").wait_for()
        assert page.locator("#notice img").count() == 0
        assert page.title() == "factorbus"
        assert complaints == []


def test_a_map_in_space_is_turned(bus: Bus, gateway: str) -> None:
    draft = Draft().se3("x0", (0, 0, 0, 0, 0, 0, 1), fixed=True)
    for i in range(4):
        draft.se3(f"x{i + 1}").between_se3(f"x{i}", f"x{i + 1}", (1, 0, 1, 0, 0, 0, 1), sigmas=[0.1] * 6)
    with bus.map("space") as joined:
        joined.insert(draft)
    with edited(gateway, "space") as page:
        page.page.select_option("#plane", "y")
        (ax, ay), (bx, by) = page.where("x0"), page.where("x4")
        assert bx - ax == pytest.approx(ay - by, abs=1), "as far up as along x"
        page.page.select_option("#plane", "orbit")
        before = page.where("x4")
        box = page.page.locator("#map").bounding_box()
        page.page.mouse.move(box["x"] + 20, box["y"] + 20)
        page.page.mouse.down()
        page.page.mouse.move(box["x"] + 120, box["y"] + 20, steps=5)
        page.page.mouse.up()
        assert page.where("x4") != before
        page.click("x2")
        page.headed("x2")


def test_a_double_click_is_one_edit_and_what_another_took_out_is_no_longer_selected(bus: Bus, gateway: str) -> None:
    with bus.map("twice") as joined:
        joined.insert(square(false_closure=True), settle=True)
        with edited(gateway, "twice") as page:
            page.click_between("x2", "x10")
            page.headed("between_se2")
            page.page.get_by_role("button", name="reject", exact=True).dblclick()
            page.headed("Done")
            assert "rejected between_se2 (x2, x10)" in page.notice("χ²")
            page.page.locator("#edits li:not(.undone)").first.wait_for()
            page.press("undo 1: rejected between_se2 (x2, x10), by local")
            page.headed("Undone")
            page.click_between("x2", "x10")
            page.headed("between_se2")
            other = Editor(gateway, "twice")
            other.edit("reject", factors=[other.factor_between("x2", "x10")])
            page.press("reject")
            page.notice("[unknown_factor]")
            assert page.page.locator("#panel h2").count() == 0


def test_a_map_that_is_dropped_is_said_to_be_gone_and_one_that_comes_is_live_again(bus: Bus, gateway: str) -> None:
    def insert() -> None:
        with bus.map("leaving") as joined:
            joined.insert(square())

    insert()
    with edited(gateway, "leaving") as page:
        state = page.page.locator("#state")
        state.get_by_text("17 variables").wait_for()
        bus.drop("leaving")
        state.get_by_text("has no map leaving any more; this is its revision 1").wait_for()
        page.click("x4")
        page.notice("[unavailable]")
        insert()
        state.get_by_text("revision 1 · 17 variables").wait_for()
        with bus.map("later") as joined:
            joined.insert(arc())
        page.page.locator("#maps").hover()
        page.page.locator("#maps option[value=later]").wait_for(state="attached")


def test_what_is_taken_out_is_counted_in_the_line_of_the_state(bus: Bus, gateway: str) -> None:
    with bus.map("thinned") as joined:
        joined.insert(square())
        with page_of(f"{gateway}/#thinned") as page:
            page.locator("#state", has_text="17 variables").wait_for()
            joined.change(Changes().remove_variables("x16"))
            page.locator("#state", has_text="1 taken out").wait_for()
