"""Jobs done by the service itself when there is no worker."""

import time

from factorbus.proto import codec
from factorbus.proto.messages import Job, JobDone, Optimum
from factorbus.proto.problems import BadMessage
from factorbus.service.questions import as_variables


def do(job: Job) -> JobDone:
    """What a worker would answer to `job`.  Raises BadMessage, SolverError."""
    if job.kind != "batch":
        raise BadMessage("job.kind", f"is {job.kind!r}", "batch")
    from factorbus.solver import solve_batch

    started = time.perf_counter()
    graph = codec.decode_graph(job.payload)
    result = solve_batch(graph.batch.variables, graph.batch.factors)
    optimum = Optimum(result.chi2, result.iterations, as_variables(result.values))
    return JobDone(job.job, job.kind, codec.encode_optimum(optimum), time.perf_counter() - started)
