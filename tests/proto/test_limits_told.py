"""The numbers of §6, §7 and §12 of the contract are those that a service has when nobody sets others."""

from dataclasses import fields
from pathlib import Path

import pytest

from factorbus.service.config import Limits
from factorbus.service.core import admission

PAGE = " ".join((Path(__file__).parents[2] / "proto" / "README.md").read_text(encoding="utf-8").split())
SET = Limits()
MIB = 1 << 20


@pytest.mark.parametrize(
    ("told", "is_so"),
    [
        ("(the last 1024 per client are remembered)", SET.remembered == 1024),
        ("admitted if fewer than 256 wait, else `busy`", SET.waiting == 256),
        ("is n+1 … n+255 | parked until the gap is closed; gap open for 5 s", SET.parked_s == 5.0),
        ("has `changes`, and 64 such of this client have no answer yet", SET.changes == 64),
        ("after 10 minutes of silence", SET.client_idle_s == 600.0),
        ("(1024 names per map)", SET.clients == 1024),
        ("1024; a quarter of them for one name before its suffix", admission._NAMES_OF_ONE == 4),
        (
            "one comes after 1000 steps or 64 MiB of deltas",
            (SET.snapshot_steps, SET.snapshot_bytes) == (1000, 64 * MIB),
        ),
        ("one message to the service | 64 MiB", SET.message_bytes == 64 * MIB),
        ("one answer | 256 MiB", SET.answer_bytes == 256 * MIB),
        ("1,000,000 variables, 1,000,000 factors", (SET.insert_variables, SET.insert_factors) == (10**6, 10**6)),
        ("different interests per map (`limits.interests`) | 64", SET.interests == 64),
        ("wait for the solver; of one service, that wait to be computed | 256 each", SET.questions == 256),
    ],
)
def test_a_number_on_the_page_is_the_one_in_force(told: str, is_so: bool) -> None:
    assert told in PAGE
    assert is_so


# Each limit by which something is refused, as the page has it, and its number.
REFUSES = {
    "maps": ("maps of one service (`limits.maps`) | 64 that are open", 64),
    "sessions": ("sessions with one service (`limits.sessions`) | 1000", 1000),
    "variables": ("one map | 20,000,000 variables", 20_000_000),
    "factors": ("variables, 100,000,000 factors |", 100_000_000),
    "clients": ("client names per map | 1024", 1024),
    "waiting": ("waiting inserts per map | 256", 256),
    "waiting_bytes": ("waiting inserts per map | 256, 256 MiB together", 256 * MIB),
    "changes": ("changes of one client without an answer | 64", 64),
    "questions": ("that wait to be computed | 256 each", 256),
    "interests": ("different interests per map (`limits.interests`) | 64", 64),
    "jobs": ("for a batch optimum, and those for features, under way | 64 each: `busy`", 64),
    "message_bytes": ("one message to the service | 64 MiB", 64 * MIB),
    "answer_bytes": ("one answer | 256 MiB", 256 * MIB),
    "insert_variables": ("one insert | 1,000,000 variables", 1_000_000),
    "insert_factors": ("1,000,000 variables, 1,000,000 factors", 1_000_000),
    "memory_bytes": ("left below `limits.memory_bytes`", 0),
    "remembered": ("(the last 1024 per client are remembered)", 1024),
    "parked_s": ("gap open for 5 s: `bad_sequence`", 5.0),
    "client_idle_s": ("after 10 minutes of silence", 600.0),
}
REFUSES_NOTHING = {
    "interest_lease_s", "snapshot_bytes", "snapshot_steps", "step_bytes", "step_inserts", "unwritten",
}  # fmt: skip


def test_every_limit_that_refuses_something_is_on_the_page() -> None:
    assert REFUSES.keys() | REFUSES_NOTHING == {each.name for each in fields(Limits)}
    assert [name for name, (told, _) in REFUSES.items() if told not in PAGE] == []
    assert {name: getattr(SET, name) for name in REFUSES} == {name: is_set for name, (_, is_set) in REFUSES.items()}
