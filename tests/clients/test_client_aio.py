"""The asyncio client against the real bus and a real service process' code, and its stream of deltas alone."""

import numpy as np

from factorbus.client.stream import DeltaStream
from factorbus.proto.messages import Delta, Variables


class Source:
    """What a stream needs of a mirror."""

    def __init__(self) -> None:
        self.callbacks: list = []
        self.last = Delta(1, 0, 0, ())

    def on_delta(self, callback):
        self.callbacks.append(callback)
        return lambda: self.callbacks.remove(callback)

    def snapshot(self):
        from factorbus.client.snapshot import Snapshot

        keys = np.arange(self.last.revision)
        return Snapshot(1, self.last.revision, {"point2": (keys, np.ones((len(keys), 2)))}, {"point2": keys})

    def step(self) -> None:
        self.last = Delta(1, self.last.revision + 1, self.last.revision, ())
        for callback in self.callbacks:
            callback(self.last)


def test_a_stream_hands_on_every_delta() -> None:
    source, woken = Source(), []
    stream = DeltaStream(source, lambda: woken.append(1), backlog=3)
    for _ in range(3):
        source.step()
    assert len(woken) == 3
    assert [stream.try_take().revision for _ in range(3)] == [1, 2, 3]
    assert stream.try_take() is None
    stream.close()
    assert not source.callbacks


def test_a_reader_that_falls_behind_gets_the_whole_estimate() -> None:
    source = Source()
    stream = DeltaStream(source, lambda: None, backlog=3)
    for _ in range(10):
        source.step()
    whole = stream.try_take()
    assert (whole.previous, whole.revision) == (0, 10)
    assert [type(group) for group in whole.variables] == [Variables]
    assert len(whole.variables[0].keys) == 10
    assert whole.variables[0].stamps.tolist() == list(range(10))
    assert stream.try_take() is None
    source.step()
    assert stream.try_take().revision == 11
