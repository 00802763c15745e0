"""Batch optima: a question's copy of the graph becomes a job, somebody does it, the question gets its answer.

For the control thread.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from factorbus.proto import codec
from factorbus.proto.messages import Chi2, JobDone
from factorbus.proto.problems import BetterOptimum, Busy, Problem
from factorbus.service.core.events import Asker
from factorbus.service.jobs.dispatch import Ended
from factorbus.service.jobs.running import Jobs
from factorbus.service.questions.answers import Question, QuestionCopies


@dataclass(slots=True)
class Optima:
    """The batch optima that are asked for."""

    jobs: Jobs
    reply: Callable[[Asker, bytes], None]
    refuse: Callable[[Asker, Any], None]
    deadline_s: float
    most: int
    open: int = 0

    def batch(self, asker: Asker, question: Question, taken: QuestionCopies) -> None:
        """Answer `question` with χ² and the batch optimum of the graph that was copied for it."""
        if self.open >= self.most:
            self.refuse(asker, Busy(self.open, 1.0))
            return
        self.open += 1

        def ended(job: Ended) -> None:
            self.open -= 1
            self._answer(asker, question, taken, job)

        self.jobs.submit("batch", codec.encode_graph(taken.graph), ended, self.deadline_s, question.timeout_s)

    def _answer(self, asker: Asker, question: Question, taken: QuestionCopies, job: Ended) -> None:
        result = job.result
        if not isinstance(result, JobDone):
            self.refuse(asker, result)
            return
        try:
            optimum = codec.decode_optimum(result.payload)
        except Problem as problem:
            self.refuse(asker, problem)
            return
        chi2 = Chi2(
            taken.epoch,
            taken.revision,
            taken.chi2,
            optimum.chi2,
            job.worker,
            result.seconds,
            optimum.start,
            BetterOptimum.or_none(taken.chi2, optimum.chi2, optimum.start),
            optimum.variables if question.values else (),
            optimum.converged,
        )
        self.reply(asker, codec.encode_chi2(chi2))
