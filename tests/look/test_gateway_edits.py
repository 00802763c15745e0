"""Edits through `factorbus gateway`: each is made by `Changes`, journalled under a name, and undone to where it was."""

import sqlite3
import urllib.error
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gateways import MERGED, Editor, problem_of, square
from processes import Process, processes

from factorbus.client import Bus, Draft, connect

pytest.importorskip("starlette")


@pytest.fixture
def bus(endpoint: str) -> Any:
    with connect(endpoint, client="robot", timeout_s=60) as opened:
        yield opened


@pytest.fixture(scope="module")
def gateway(endpoint: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of one that all tests share: each has maps of its own."""
    with processes(tmp_path_factory.mktemp("gateway")) as start:
        yield start("-m", "factorbus.cli", "gateway", "--connect", endpoint, "--port", "0").ready()[0]


def refused(act: Callable[[], Any]) -> dict[str, Any]:
    with pytest.raises(urllib.error.HTTPError) as raised:
        act()
    return problem_of(raised.value)


def test_a_false_closure_is_rejected_and_comes_back(bus: Bus, gateway: str) -> None:
    editor = Editor(gateway, "rejected")
    with bus.map("rejected") as joined:
        joined.insert(square(false_closure=True), settle=True)
        before = joined.chi2().chi2
        closure = editor.factor_between("x2", "x10")
        made = editor.edit("reject", factors=[closure])
        assert (made["number"], made["who"], made["what"]) == (1, "local", "rejected between_se2 (x2, x10)")
        assert made["chi2"] < 1e-6 < 10 < made["chi2_before"]
        told = editor.ask("edits")
        assert [each["id"] for each in told["rejected"]] == [closure]
        assert told["undo"]["number"] == 1
        # Restored it has another id; it is called by the one it had, and undoing goes through all of it.
        assert editor.edit("restore", factors=[closure])["chi2"] == pytest.approx(before, rel=1e-6)
        again = editor.factor_between("x2", "x10")
        assert again != closure
        assert editor.ask(f"factors/{again}")["inserted"] is None, (
            "a robot measured it, also after somebody restored it"
        )
        assert editor.ask("edits")["rejected"] == []
        assert refused(lambda: editor.edit("restore", factors=[closure]))["code"] == "bad_option"
        assert editor.edit("undo", number=2)["undone"] == "local"
        assert [each["id"] for each in editor.ask("edits")["rejected"]] == [closure]
        assert joined.chi2().chi2 < 1e-6
        assert editor.edit("undo", number=1)["chi2"] == pytest.approx(before, rel=1e-6)
        assert editor.ask("edits")["undo"] is None
        group = next(g for g in joined.graph().batch.factors if g.kind == "between_se2")
        assert group.keys.shape == (18, 2)


def test_a_weight_and_what_is_held_are_undone(bus: Bus, gateway: str) -> None:
    editor = Editor(gateway, "weighed")
    with bus.map("weighed") as joined:
        joined.insert(square(false_closure=True), settle=True)
        closure = editor.factor_between("x2", "x10")
        before = editor.ask(f"factors/{closure}")
        np.testing.assert_allclose(before["sigmas"], (0.05, 0.05, 0.02), rtol=1e-9)
        assert before["measured"] == [0, 0, 0]
        assert before["chi2"] == pytest.approx(np.square(before["weighted"]).sum())
        editor.edit("weigh", factors=[closure], weight=0.01)
        np.testing.assert_allclose(editor.ask(f"factors/{closure}")["sigmas"], (0.5, 0.5, 0.2), rtol=1e-9)
        held = editor.edit("fix", keys=["x5", "x0", "x6"])
        assert held["what"] == "held x5, x6", "x0 was held already, and stays so when this is undone"
        assert editor.ask("edges")["fixed"] == ["x0", "x5", "x6"]
        assert refused(lambda: editor.edit("fix", keys=["x5"]))["code"] == "bad_option"
        editor.edit("free", keys=["x6"])
        for number in (3, 2, 1):
            editor.edit("undo", number=number)
        assert editor.ask("edges")["fixed"] == ["x0"]
        np.testing.assert_allclose(editor.ask(f"factors/{closure}")["sigmas"], before["sigmas"], rtol=1e-9)


def test_a_pose_is_put_somewhere_and_a_landmark_anchored(bus: Bus, gateway: str) -> None:
    editor = Editor(gateway, "placed")
    with bus.map("placed") as joined:
        joined.insert(square().point2("l0").landmark_se2("x3", "l0", (1, 0), sigmas=(0.1, 0.1)), settle=True)
        editor.edit("prior", key="x4", value=[4.5, 0.5, 1.570796], sigmas=[0.001, 0.001, 0.001])
        joined.estimate.wait_for(joined.stats()["revision"])
        np.testing.assert_allclose(joined.estimate["x4"], (4.5, 0.5, 1.570796), atol=0.01)
        prior = next(group for group in joined.graph().batch.factors if group.kind == "prior_se2")
        assert prior.ids is not None
        inserted = editor.ask(f"factors/{int(prior.ids[0])}")["inserted"]
        assert (inserted["number"], inserted["who"]) == (1, "local")
        editor.edit("anchor", key="x8", place=[4.2, 4.2], sigma=0.001)
        editor.edit("anchor", key="l0", place=[5.0, 1.0], sigma=0.001)
        joined.estimate.wait_for(joined.stats()["revision"])
        np.testing.assert_allclose(joined.estimate["x8"][:2], (4.2, 4.2), atol=0.01)
        np.testing.assert_allclose(joined.estimate["l0"], (5.0, 1.0), atol=0.01)
        assert refused(lambda: editor.edit("anchor", key="x8", place=[1.0, 2.0, 3.0], sigma=1))["code"] == "bad_shape"
        assert refused(lambda: editor.edit("prior", key="l0", value=[1], sigmas=[1, 1]))["code"] == "bad_shape"
        for number in (3, 2, 1):
            editor.edit("undo", number=number)
        assert joined.graph().batch.factor_count == 18
        assert joined.chi2().chi2 < 1e-6


def test_maps_are_merged_by_pairs_and_parted_again(bus: Bus, gateway: str) -> None:
    editor = Editor(gateway, "town")
    with bus.map("town") as town, bus.map("yard") as yard:
        town.insert(square(), settle=True)
        yard.insert(square(), settle=True)
        factors = town.graph().batch.factor_count
        # Half a turn apart: corner for corner.
        pairs = [["x0", "x8"], ["x4", "x12"], ["x8", "x0"]]
        made = editor.edit("merge", pairs=pairs, **MERGED)
        assert made["what"] == "merged map yard by 3 pairs"
        merge = made["merge"]
        assert (merge["variables"], merge["letters"], merge["left_out"]) == (17, {"x": "a"}, {"fixed": 1})
        np.testing.assert_allclose(np.abs(merge["frame"]), (4, 4, np.pi), atol=1e-4)
        assert [pair["keys"] for pair in merge["pairs"]] == [["x0", "a8"], ["x4", "a12"], ["x8", "a0"]]
        assert max(pair["misfit"] for pair in merge["pairs"]) < 1e-3
        town.estimate.wait_for(int(town.stats()["revision"]))
        np.testing.assert_allclose(town.estimate["a8"][:2], town.estimate["x0"][:2], atol=1e-3)
        assert yard.graph().batch.variable_count == 17
        editor.edit("undo", number=1)
        graph = town.graph().batch
        assert (graph.variable_count, graph.factor_count) == (17, factors)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"pairs": [["x0", "l0"]]}, "cannot_merge"),
        ({"pairs": [["x0", "x99"]]}, "cannot_merge"),
        ({"pairs": [["x0", "x4"], ["x0", "x4"]]}, "cannot_merge"),
        ({"other": "nowhere"}, "unknown_map"),
        ({"sigmas": [0.1]}, "bad_shape"),
        ({"absolute": "refuse"}, "absolute_factors"),
    ],
)
def test_a_merge_that_cannot_be_says_why(bus: Bus, gateway: str, change: dict[str, Any], code: str) -> None:
    with bus.map("hall") as hall, bus.map("attic") as attic:
        if not hall.estimate.revision:
            hall.insert(square())
            attic.insert(square().point2("l0", (1, 1)).prior_point2("l0", (1, 1), sigmas=(1, 1)))
        hall.wait_converged()  # no further step of its own is counted
        asked = {"other": "attic", "pairs": [["x0", "x4"]], "sigmas": [0.1, 0.1, 0.05], "absolute": "leave_out"}
        revision = hall.stats()["revision"]
        problem = refused(lambda: Editor(gateway, "hall").edit("merge", **(asked | change)))
        assert problem["code"] == code
        assert hall.stats()["revision"] == revision


def test_what_the_service_refuses_comes_in_its_words_and_changes_nothing(bus: Bus, gateway: str) -> None:
    editor = Editor(gateway, "chain")
    with bus.map("chain") as joined:
        chain = Draft().se2("x0", (0, 0, 0), fixed=True).se2("x1")
        joined.insert(chain.between_se2("x0", "x1", (1, 0, 0), sigmas=(0.1, 0.1, 0.1)))
        joined.wait_converged()
        revision = joined.stats()["revision"]
        only = editor.factor_between("x0", "x1")
        problem = refused(lambda: editor.edit("reject", factors=[only]))
        assert (problem["status"], problem["code"]) == (409, "underconstrained")
        assert "x1" in problem["message"]
        assert refused(lambda: editor.edit("free", keys=["x0"]))["code"] == "underconstrained"
        assert refused(lambda: editor.edit("reject", factors=[99]))["code"] == "unknown_factor"
        assert refused(lambda: editor.edit("fix", keys=["x9"]))["code"] == "unknown_variable"
        assert refused(lambda: editor.edit("undo", number=1))["code"] == "nothing_to_undo"
        assert joined.stats()["revision"] == revision
        assert editor.ask("edits") == {"edits": [], "undo": None, "rejected": []}


def test_only_the_last_edit_is_undone_and_a_new_map_has_none(bus: Bus, gateway: str) -> None:
    editor = Editor(gateway, "short")
    with bus.map("short") as joined:
        joined.insert(square())
        editor.edit("fix", keys=["x1"])
        editor.edit("fix", keys=["x2"])
        problem = refused(lambda: editor.edit("undo", number=1))
        assert problem["code"] == "nothing_to_undo"
        assert "that is 2, held x2, by local" in problem["message"]
    bus.drop("short")
    with bus.map("short") as joined:
        joined.insert(square())
        assert editor.ask("edits")["edits"] == []
        assert refused(lambda: editor.edit("undo", number=2))["code"] == "nothing_to_undo"


def test_an_edit_is_in_the_journal_under_the_name_of_who_made_it(spawn: Callable[..., Process], tmp_path: Path) -> None:
    people, folder, secret = tmp_path / "people.toml", tmp_path / "maps", "an-operators-token"
    people.write_text(f'[operator]\nann = "{secret}"\n')
    serve = ("-m", "factorbus.cli", "serve", "--listen", "tcp/127.0.0.1:0", "--no-warm", "--journal", str(folder))
    (endpoint,) = spawn(*serve).ready()
    show = ("-m", "factorbus.cli", "gateway", "--connect", endpoint, "--port", "0", "--people", str(people))
    (address,) = spawn(*show).ready()
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("kept") as joined:
        joined.insert(square())
        assert Editor(address, "kept", secret).edit("fix", keys=["x3"])["who"] == "ann"
    with closing(sqlite3.connect(next(folder.rglob("journal.db")))) as journal:
        clients = [client for (client,) in journal.execute("SELECT client FROM entry ORDER BY number")]
    assert [client.rpartition("-")[0] for client in clients] == ["robot", "gateway-ann"]


def test_closures_that_a_map_tests_are_accepted_and_rejected(bus: Bus, gateway: str) -> None:
    editor = Editor(gateway, "tested")
    with bus.map("tested", closures="test") as joined:
        joined.insert(square(false_closure=True))
        (suspect,) = editor.ask("suspects")["closures"]
        assert (suspect["keys"], suspect["state"], suspect["reason"]) == (["x2", "x10"], "suspect", "improbable")
        assert suspect["distance"] > 100
        assert 0.98 < suspect["chance"] <= 1, "the odds that it is false"
        made = editor.edit("accept_closures", factors=[suspect["id"]])
        assert made["what"] == f"accepted closure {suspect['id']}"
        assert made["chi2"] > 10 > made["chi2_before"]
        assert editor.factor_between("x2", "x10") == suspect["id"], "it has the id that it had"
        assert editor.edit("undo", number=1)["undone"] == "local"
        (rejected,) = editor.ask("suspects")["closures"]
        assert (rejected["id"], rejected["state"], rejected["reason"]) == (suspect["id"], "rejected", "user")
        assert refused(lambda: editor.edit("reject_closures", factors=[0]))["code"] == "not_a_closure"
        right = editor.factor_between("x0", "x16")
        assert editor.edit("reject_closures", factors=[right])["what"] == f"rejected closure {right}"
        assert [row["state"] for row in editor.ask("suspects")["closures"]] == ["rejected", "rejected"]


def test_what_an_editor_restores_in_such_a_map_is_not_tested_again(bus: Bus, gateway: str) -> None:
    editor = Editor(gateway, "restored")
    with bus.map("restored", closures="test") as joined:
        joined.insert(square(false_closure=True))
        false = editor.ask("suspects")["closures"][0]["id"]
        editor.edit("accept_closures", factors=[false])
        editor.edit("reject", factors=[false])
        assert not editor.ask("suspects")["closures"]
        editor.edit("restore", factors=[false])
        assert editor.factor_between("x2", "x10") > false
        assert sum(joined.stats()["closure_states"].values()) == 1
