"""The numbers of §6, §7 and §12 of the contract are those that a service has when nobody sets others."""

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
