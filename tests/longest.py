"""The files whose tests take longest, in the order in which they begin when tests run side by side."""

from pathlib import PurePath

# Each the better part of a minute on one core, or longer.  One that began last would be what all others wait for.
FILES = (
    "test_docs.py",
    "clients/test_cli_demo.py",
    "system/test_converging.py",
    "clients/test_cli_replay.py",
    "system/test_journal_disk.py",
    "look/test_gateway_edit_page.py",
    "solver/test_numba_as_found.py",
    "solver/test_jit.py",
    "clients/test_newcomer.py",
    "ros2/test_ros2_hostile.py",
    "system/test_traffic_while_converging.py",
    "ros2/test_recordings.py",
    "system/test_network.py",
    "look/test_watch.py",
    "bench/test_peers.py",
    "solver/test_derived_kinds.py",
    "solver/test_mixed_marginals.py",
    "solver/test_factor_kinds.py",
)


def rank(path: PurePath) -> int:
    """Of a file of tests: its place among these; behind them all others are equal."""
    of = {PurePath(name).parts: n for n, name in enumerate(FILES)}
    return of.get(path.parts[-2:], of.get(path.parts[-1:], len(FILES)))
