"""What each kind of job does.  A job is a pure function of its payload, so that any worker, or two, may do it.

batch    a Graph            → Optimum: the graph optimized from scratch
idp      a Shard            → ShardDone: new features of a monocular filter, with their covariance
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from factorbus.proto import codec
from factorbus.proto.messages import Optimum, Variables
from factorbus.proto.problems import UnknownKind


def run_job(kind: str, payload: bytes) -> bytes:
    """The result of a job of `kind`.  Raises Problem, SolverError."""
    job = JOBS.get(kind)
    if job is None:
        raise UnknownKind("job.kind", kind, tuple(JOBS))
    return job(payload)


def batch(payload: bytes) -> bytes:
    """The optimum of an encoded Graph, as an encoded Optimum.  Raises BadMessage, TooLarge, SolverError."""
    from factorbus.solver import solve_batch

    graph = codec.decode_graph(payload).batch
    result = solve_batch(graph.variables, graph.factors)
    values = tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in result.values)
    optimum = Optimum(result.chi2, result.iterations, values, result.start, result.converged)
    return codec.encode_optimum(optimum)


def idp(payload: bytes) -> bytes:
    """New features, as an encoded ShardDone.  Raises BadMessage, TooLarge, BadCamera, BadShape, BadState, BadPixel."""
    from factorbus.idp import job

    return job.do(payload)


JOBS: Mapping[str, Callable[[bytes], bytes]] = MappingProxyType({"batch": batch, "idp": idp})
