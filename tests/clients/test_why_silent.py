"""Where nobody replies it is said what may be the reason, of each thing that is asked for."""

import pytest

from factorbus.client.replies import why_silent
from factorbus.proto import keys


@pytest.mark.parametrize(
    ("key", "may"),
    [
        (keys.admin_key("create"), "create maps? One that may not joins a map that is there, in Python with create="),
        (keys.admin_key("drop"), "do that, which is an operator's?"),
        (keys.admin_key("fork"), "do that, which is an operator's?"),
        (keys.admin_key("maps"), "ask?"),
        (keys.admin_key("stats"), "ask?"),
        (keys.ask_key("hall", "stats"), "ask?"),
        (keys.insert_key("hall", "robot1-0a"), "insert under this name?"),
        (keys.features_key("s1"), "ask?"),
    ],
)
def test_silence_may_be_access_control(key: str, may: str) -> None:
    told = why_silent(key)
    assert told.startswith(f"is it running, and may this client {may}")
    assert told.endswith("(access control drops what it denies without a word)")
