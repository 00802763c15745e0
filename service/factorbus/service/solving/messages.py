"""The messages that tell of a step, written by the compiled writer: the answers to its inserts, and its delta."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from factorbus.proto import codec
from factorbus.service.kernels.write import NO_DELTA, write_messages
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.jit.compile import I64

# Of a usual step; those of a larger one are written to an array of their own.
ROOM = 48 << 10
_NOTHING = np.empty(0, np.int64)


class StepMessages:
    """Writes the messages of the steps of one map.  For one thread at a time.

    What the writer is given of a usual step, which has one insert, is put into arrays that are there already: to make
    them anew takes as long as to write the messages.
    """

    def __init__(self) -> None:
        self._out = np.empty(ROOM, np.uint8)
        self._pack = codec.report_encoder()
        self._step, self._answer, self._ends = np.empty(3, np.int64), np.empty((1, 2), np.int64), np.empty(2, np.int64)
        self._step_view, self._answer_view, self._written = self._step.data, self._answer[0].data, self._out.data

    def write(
        self,
        answers: Sequence[tuple[int, int]],
        step: tuple[int, int, int],
        reported: Mapping[str, Any],
        changed: I64,
        graph: FactorGraph,
    ) -> list[bytes]:
        """The answers to the inserts of a step, and its delta.

        answers: of each insert its sequence number and the id of its first factor.  step: epoch, revision, and the one
        before.  changed: the variables that the delta tells of, ascending.
        """
        view = self._step_view
        view[0], view[1], view[2] = step
        if len(answers) == 1:
            numbers, ends, view = self._answer, self._ends, self._answer_view
            view[0], view[1] = answers[0]
        else:
            numbers, ends = np.array(answers, np.int64).reshape(-1, 2), np.empty(len(answers) + 1, np.int64)
        report, out, written = self._pack(reported), self._out, self._written
        size = write_messages(numbers, self._step, report, changed, graph.array_table, out, ends)
        if size > len(out):
            out = np.empty(size, np.uint8)
            write_messages(numbers, self._step, report, changed, graph.array_table, out, ends)
            written = out.data
        messages, begin = [], 0
        for end in ends.tolist():
            messages.append(written[begin:end].tobytes())
            begin = end
        return messages

    def write_answers(
        self, answers: Sequence[tuple[int, int]], epoch: int, revision: int, reported: Mapping[str, Any]
    ) -> list[bytes]:
        """The answers alone."""
        return self.write(answers, (epoch, revision, NO_DELTA), reported, _NOTHING, FactorGraph())[:-1]

    def write_delta(
        self, step: tuple[int, int, int], reported: Mapping[str, Any], changed: I64, graph: FactorGraph
    ) -> bytes:
        """The delta alone."""
        return self.write((), step, reported, changed, graph)[0]
