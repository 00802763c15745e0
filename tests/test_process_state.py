"""A test that leaves its process changed is told what it has changed, and the next test has it as it was."""

import gc
import logging
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from process_state import as_it_was

CHANGES: dict[str, Callable[[Path], object]] = {
    "the environment was {}, is {'FACTORBUS_X': '1'}": lambda _: os.environ.update(FACTORBUS_X="1"),
    "the working folder": os.chdir,
    "sys.path": lambda folder: sys.path.insert(0, str(folder)),
    r"the garbage collector was \(True": lambda _: gc.disable(),
    "the garbage collector": lambda _: gc.set_threshold(20_000, 50, 100),
    "the garbage collector was ": lambda _: gc.freeze(),
    "the switch interval": lambda _: sys.setswitchinterval(0.0005),
    "signal handlers was .*SIGALRM": lambda _: signal.signal(signal.SIGALRM, lambda *_: None),
    "the root logger": lambda _: logging.getLogger().setLevel(logging.DEBUG),
    "the root logger was ": lambda _: logging.disable(logging.CRITICAL),
    "the umask": lambda _: os.umask(0o777),
    "the cores": lambda _: os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}),
}


@pytest.mark.parametrize("told", CHANGES)
def test_what_a_test_leaves_changed_is_told_and_put_back(told: str, tmp_path: Path) -> None:
    if told == "the cores" and (not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) == 1):
        pytest.skip("one core: there is nothing to change")
    with pytest.raises(AssertionError, match=f"the test leaves its process changed: {told}"), as_it_was():
        CHANGES[told](tmp_path)
    with as_it_was():
        pass


def test_what_is_put_back_by_the_test_is_its_own_affair(monkeypatch: pytest.MonkeyPatch) -> None:
    with as_it_was():
        with monkeypatch.context() as patch:
            patch.setenv("FACTORBUS_X", "1")
        assert "FACTORBUS_X" not in os.environ
