"""Tables in a narrow terminal: no number is broken, and what has no room is left away whole."""

from typing import Any

import pytest
from rich.console import Console

from factorbus.cli.commands import stats, top
from factorbus.cli.output import console as screen

MAP = {
    "name": "warehouse", "mode": "bayes-tree", "variables": 9780, "factors": 13214, "revision": 9780,
    "steps_per_s": 118.3, "inserts_per_s": 118.3, "step_ms": 3.25, "chi2": 801198.5, "converging": True,
    "gave_up": "", "waiting": 12, "parked": 3, "refused": 4, "busy": 2,
}  # fmt: skip
SEEN: dict[str, Any] = {
    "unavailable": "", "service": "s", "version": "1", "answer_ms": 1.0, "unopened": [], "maps": [MAP],
    "clients": [
        {"name": "a" * 64, "map": "m" * 64, "inserts": 9780, "inserts_per_s": 1.0, "here": True},
        {"name": "b", "map": "hall", "inserts": 1, "inserts_per_s": 0.0, "here": False},
    ],
    "workers": [{"name": "w", "slots": 1, "in_flight": 0, "latency_ms": 12.5}],
    "interests": [],
}  # fmt: skip


def shown(width: int, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("TERM", "dumb")
    console = Console(width=width, highlight=False, color_system=None)
    with console.capture() as captured:
        console.print(top.view(SEEN, "tcp/127.0.0.1:7447", console))
    return captured.get()


@pytest.mark.parametrize("width", [40, 60, 80, 100, 200])
def test_top_breaks_no_number(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = shown(width, monkeypatch).splitlines()
    assert max(map(len, lines)) <= width
    (row,) = (line.split() for line in lines if line.strip().startswith("warehouse"))
    whole = {"warehouse", "bayes-tree", "9,780", "13,214", "118.3", "3.25", "801198", "converging", "12", "+3", "4,"}
    assert set(row) <= whole | {"2", "busy"}, "every word of it is a whole one"
    assert "9,780" in row
    assert any(line.strip() == "1 client gone, after 1 insert" for line in lines)
    if width >= 80:
        assert {"3.25", "converging"} <= set(row)
    (client,) = (line.split() for line in lines if line.strip().startswith("aaaa") and "9,780" in line)
    assert client[-2:] == (["9,780", "1.0"] if width > 40 else ["m" * 12, "9,780"])
    if width == 200:
        assert client[:2] == ["a" * 64, "m" * 64]
        assert row[1:4] == ["bayes-tree", "9,780", "13,214"]


def test_a_title_is_as_wide_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    title = "Standard deviations at revision 12345, of which there are many"
    screen.table([("x1", "0.1")], title=title)
    assert capsys.readouterr().out.splitlines()[0].strip() == title


def test_fields_of_a_journal_are_rounded_and_empty_ones_left_away() -> None:
    fields = {"durability": "commit", "commits": 31, "commit_ms": 332.3176280064217, "longest_commit_ms": 12345.6}
    told = dict(stats.shown_fields(fields | {"problem": "", "seconds": 0.0123456}))
    assert told == {
        "durability": "commit",
        "commits": "31",
        "commit ms": "332",
        "longest commit ms": "12,346",
        "seconds": "0.0123",
    }


def test_top_counts_what_a_map_took_out_where_any_keeps_some_poses_alone() -> None:
    names, _ = top._maps(SEEN)
    assert "taken out" not in names
    kept = {"removed_poses": 12345, "failed": False}
    maps = [MAP, MAP | {"kept": kept}, MAP | {"kept": kept | {"failed": True}}]
    names, rows = top._maps(SEEN | {"maps": maps})
    assert [row[names.index("taken out")] for row in rows] == ["", "12,345", "12,345, failed"]
