"""After a crash who asks again gets what was answered first, to the byte: accepted or refused, with its report."""

import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
from bare import Bare, bare, edge, pose, start
from journalled import Services

from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch, Change, Insert
from factorbus.proto.problems import Refused

INSERTS = (
    Insert(1, start()),
    Insert(2, pose("x1", "x0")),
    Insert(3, pose("x2", "x1")),
    Insert(4, Batch((), (edge("x0", "x9"),))),  # refused
    Insert(5, Batch((), (edge("x2", "x0", 0.5),)), settle=True),
    Insert(6, Batch(), changes=(Change("weigh", np.array([1]), weight=np.array([2.0])),)),
    Insert(7, Batch()),
)


def answers(client: Bare) -> list[bytes]:
    """What each of them is answered: an accepted, or a problem with all that it says."""
    told = []
    for insert in INSERTS:
        came = client.ask(keys.insert_key("m", "robot"), codec.encode_insert(insert))
        assert came is not None
        told.append(codec.encode_problem(came) if isinstance(came, Refused) else came)
    return told


def test_a_repeated_insert_gets_its_first_answer_whole_after_a_crash(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    running = services(tmp_path / "journal")
    with bare(running.start()) as client:
        first = answers(client)
        assert answers(client) == first
    for number in (signal.SIGKILL, signal.SIGTERM):
        running.end(number)
        with bare(running.start()) as client:
            assert answers(client) == first
    refused = codec.decode_problem(first[3])
    assert (refused.code, refused.detail["next"]) == ("unknown_variable", 5)
    for message in first[:3] + first[4:]:
        report = codec.decode_accepted(message).report
        assert {"mode", "strategy", "because", "chi2", "chi2_before", "converged", "step_ms", "solver_ms"} <= set(
            report
        )
    assert codec.decode_accepted(first[5]).report["edited_factors"] == 1
