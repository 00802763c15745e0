"""Workers that answer wrongly, in a process of their own: worker.py ENDPOINT

Reads lines `NAME FAULT`: a worker NAME is there from then on, until the next line; prints `born NAME`.  It does every
job as it should be done and damages what it answers; jobs that only measure the way to it are left alone, unless the
fault is `probe`.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import zenoh
from zenoh.handlers import Callback

from factorbus.proto import codec, keys
from factorbus.proto.features import ShardDone
from factorbus.proto.features_codec import decode_shard_done, encode_shard_done
from factorbus.proto.messages import Job, JobDone, Optimum, Variables
from factorbus.proto.problems import BadMessage, Problem, Refused
from factorbus.solver import SolverError
from factorbus.workers import jobs

Damage = Callable[[Optimum], Optimum]


def other_chi2(chi2: float) -> Damage:
    """The right values, and another χ²."""
    return lambda right: Optimum(chi2, right.iterations, right.variables)


def other_values(change: Callable[[Variables], Variables]) -> Damage:
    """The right χ², and other variables of the group that is not fixed."""

    def damage(right: Optimum) -> Optimum:
        groups = tuple(group if group.fixed else change(group) for group in right.variables)
        return Optimum(right.chi2, right.iterations, groups)

    return damage


def moved(group: Variables) -> Variables:
    return Variables(group.kind, group.keys, group.values + 0.25)


def to_nan(group: Variables) -> Variables:
    return Variables(group.kind, group.keys, np.full_like(group.values, np.nan))


OPTIMA: dict[str, Damage] = {
    "chi2_negative": other_chi2(-1.0),
    "chi2_nan": other_chi2(float("nan")),
    "chi2_other": other_chi2(0.5),
    "start_unknown": lambda right: Optimum(right.chi2, right.iterations, right.variables, "x\0"),
    "early": lambda right: replace(right, converged=False),  # which is for it alone to know
    "values_moved": other_values(moved),
    "values_nan": other_values(to_nan),
    "one_missing": other_values(lambda g: Variables(g.kind, g.keys[1:], g.values[1:])),
    "other_keys": other_values(lambda g: Variables(g.kind, g.keys + 1000, g.values)),
    "one_twice": other_values(lambda g: Variables(g.kind, np.repeat(g.keys[:1], len(g.keys)), g.values)),
    "other_kind_of_variable": other_values(lambda g: Variables("point2", g.keys, g.values[:, :2])),
}


def with_y(done: ShardDone, column: int, number: float) -> ShardDone:
    y = done.y.copy()
    y[0, column] = number
    return done._replace(y=y)


SHARDS: dict[str, Callable[[ShardDone], ShardDone]] = {
    "y_nan": lambda done: with_y(done, 3, np.nan),
    "y_elsewhere": lambda done: with_y(done, 0, done.y[0, 0] + 1.0),
    "shard_of_another": lambda done: done._replace(first=done.first + 1, y=done.y[1:]),
    "rows_short": lambda done: done._replace(stored=False, rows=np.zeros((6 * len(done.y), 7))),
    "neither": lambda done: done._replace(stored=False),
}


def answer(job: Job, fault: str) -> bytes | Exception | None:
    """The damaged answer to `job`, or a problem."""
    if fault == "refuses":
        return BadMessage("graph", "no map", "a map")
    if fault == "refuses_the_graph":
        return Refused("underconstrained", "x1 is free to move", {})
    if fault == "unreadable":
        return b"\xc1\xc1"
    result = jobs.run_job(job.kind, job.payload)
    if fault in OPTIMA:
        result = codec.encode_optimum(OPTIMA[fault](codec.decode_optimum(result)))
    if fault in SHARDS:
        result = encode_shard_done(SHARDS[fault](decode_shard_done(result)))
    if fault == "converged_no_bool":
        result = codec.encode_map(codec.decode_map(result) | {"converged": "no"})
    if fault == "unreadable_payload":
        result = result[:-1]
    name = "another" if fault == "other_job" else job.job
    kind = "bake" if fault == "other_kind" else job.kind
    return codec.encode_job_done(JobDone(name, kind, result, -1.0 if fault == "seconds" else 0.01))


def main() -> None:
    """A worker for every line."""
    config = zenoh.Config()
    for path, value in {
        "mode": "client",
        "connect/endpoints": [sys.argv[1]],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        print("ready", flush=True)
        declared: list = []
        for line in sys.stdin:
            name, fault = line.split()
            while declared:
                declared.pop().undeclare()
            declared.append(session.declare_queryable(keys.job_key(name), Callback(taking(fault), indirect=False)))
            declared.append(session.liveliness().declare_token(keys.worker_token(name, 2)))
            print("born", name, flush=True)


def taking(fault: str) -> Callable[[zenoh.Query], None]:
    """What such a worker does with a job."""

    def take(query: zenoh.Query) -> None:
        with query:
            job = codec.decode_job(query.payload.to_bytes() if query.payload else b"")
            if fault == "unreadable_problem" and not job.job.startswith("probe-"):
                query.reply_err(b"\xc1")
                return
            if job.kind == "idp" and fault == "only_batch":
                query.reply_err(codec.encode_problem(Refused("unknown_kind", "idp", {})))
                return
            probed = job.job.startswith("probe-")
            damaged = "other_job" if probed and fault == "probe" else "" if probed else fault
            try:
                found = answer(job, damaged)
            except (Problem, SolverError) as problem:
                found = problem
            if isinstance(found, bytes):
                query.reply(query.key_expr, found)
            else:
                query.reply_err(codec.encode_problem(found))

    return take


if __name__ == "__main__":
    main()
