"""Jobs done by the service itself when there is no worker, or when the way to one would take longer."""

import time

from factorbus.proto import codec
from factorbus.proto.messages import Job, JobDone, Optimum
from factorbus.proto.problems import UnknownKind
from factorbus.service.questions.answers import as_variables


def do(job: Job) -> JobDone:
    """What a worker would answer to `job`, bit for bit.  Raises Problem, SolverError."""
    if job.kind not in _DO:
        raise UnknownKind("job.kind", job.kind, tuple(_DO))
    started = time.perf_counter()
    return JobDone(job.job, job.kind, _DO[job.kind](job.payload), time.perf_counter() - started)


def _batch(payload: bytes) -> bytes:
    from factorbus.solver import solve_batch

    graph = codec.decode_graph(payload)
    result = solve_batch(graph.batch.variables, graph.batch.factors)
    values = as_variables(result.values)
    optimum = Optimum(result.chi2, result.iterations, values, result.start, result.converged)
    return codec.encode_optimum(optimum)


def _idp(payload: bytes) -> bytes:
    from factorbus.idp import job

    return job.do(payload)


_DO = {"batch": _batch, "idp": _idp}
