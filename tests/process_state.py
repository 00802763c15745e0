"""What belongs to the whole test process: a test that leaves it changed fails, and the others have it as it was."""

import gc
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_OF_PYTEST = ("PYTEST_CURRENT_TEST",)  # written by pytest between set-up and call
_SIGNALS = sorted(set(signal.Signals) - {signal.SIGKILL, signal.SIGSTOP})


@contextmanager
def as_it_was() -> Iterator[None]:
    """Inside, nothing of the process may change for good.  Raises AssertionError, with the process as it was before."""
    before = _state()
    yield
    after = _state()
    changed = {name: (before[name], after[name]) for name in before if before[name] != after[name]}
    for name in changed:
        _RESTORE[name](before[name])
    told = "; ".join(f"{name} was {_short(old, new)}, is {_short(new, old)}" for name, (old, new) in changed.items())
    assert not changed, f"the test leaves its process changed: {told}"


def _state() -> dict[str, Any]:
    umask = os.umask(0)
    os.umask(umask)
    root = logging.getLogger()
    return {
        "the environment": {name: value for name, value in os.environ.items() if name not in _OF_PYTEST},
        "the working folder": os.getcwd(),
        "sys.path": list(sys.path),
        "the garbage collector": (gc.isenabled(), gc.get_threshold(), gc.get_freeze_count() > 0),
        "the switch interval": sys.getswitchinterval(),
        "signal handlers": {number: signal.getsignal(number) for number in _SIGNALS},
        "the root logger": (root.level, root.disabled, logging.root.manager.disable),
        "the umask": umask,
        "the cores": os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(),
    }


def _restore_environment(wanted: dict[str, str]) -> None:
    for name in os.environ.keys() - wanted.keys() - set(_OF_PYTEST):
        del os.environ[name]
    os.environ.update(wanted)


def _restore_path(wanted: list[str]) -> None:
    sys.path[:] = wanted


def _restore_collector(wanted: tuple[bool, tuple[int, int, int], bool]) -> None:
    enabled, thresholds, frozen = wanted
    (gc.enable if enabled else gc.disable)()
    gc.set_threshold(*thresholds)
    if not frozen:
        gc.unfreeze()


def _restore_handlers(wanted: dict[signal.Signals, Any]) -> None:
    for number, handler in wanted.items():
        if signal.getsignal(number) != handler:
            signal.signal(number, handler)


def _restore_logging(wanted: tuple[int, bool, int]) -> None:
    root = logging.getLogger()
    level, root.disabled, disabled = wanted
    root.setLevel(level)
    logging.disable(disabled)


_RESTORE: dict[str, Callable[[Any], object]] = {
    "the environment": _restore_environment,
    "the working folder": os.chdir,
    "sys.path": _restore_path,
    "the garbage collector": _restore_collector,
    "the switch interval": sys.setswitchinterval,
    "signal handlers": _restore_handlers,
    "the root logger": _restore_logging,
    "the umask": os.umask,
    "the cores": lambda wanted: os.sched_setaffinity(0, wanted),
}


def _short(seen: Any, other: Any) -> Any:
    """Of a table, only what differs."""
    if isinstance(seen, dict):
        return {name: value for name, value in seen.items() if other.get(name, other) != value}
    return seen
