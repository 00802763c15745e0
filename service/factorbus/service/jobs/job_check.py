"""Whether what a worker answers can be the answer to its job: nothing of it is passed on before.  Pure.

    any job   its name and kind; a payload that can be read; seconds that are a time
    batch     all free variables of the graph, once each, of their kind, finite; χ² is that of these values; a start
              that there is; `converged`, where it is there, true or false
    idp       the features that were asked for, all arrays of the form with their shapes; y begins where the camera is
              and ends with the prior of ρ; finite

That an optimum is one, and that covariances are right, is not looked at: that would be the job once more.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from factorbus.proto import codec
from factorbus.proto.features import FEATURE, Ask, ShardDone
from factorbus.proto.features_codec import decode_ask, decode_shard, decode_shard_done
from factorbus.proto.limits import ANSWER_LIMITS
from factorbus.proto.messages import STARTS, Job, JobDone, Variables
from factorbus.proto.problems import Problem
from factorbus.solver.errors import SolverError
from factorbus.wording import counted

# χ² is summed in another order, or by another compiler; an optimum is compared with a map by no more digits.
_CHI2 = 1e-6
# A larger payload is not checked on the control thread.
_QUICK_BYTES = 256 << 10


class WrongAnswer(Problem):
    """What a worker answered cannot be right: `message` goes on where "worker w1" ends.  It is never sent."""

    code = "wrong_answer"


class DoubtfulAnswer(WrongAnswer):
    """What it answered has no meaning, and it may be the job that has none."""


def is_quick(done: JobDone) -> bool:
    """Whether checking `done` takes no time worth a thread of its own."""
    return done.kind != "batch" and len(done.payload) <= _QUICK_BYTES


def checked_result(job: Job, done: JobDone) -> JobDone | WrongAnswer:
    """`done` if it can be the answer to `job`, else what is wrong with it."""
    try:
        _check_envelope(job, done)
        _CHECKS[job.kind](job.payload, done.payload)
    except WrongAnswer as wrong:
        return wrong
    except SolverError as problem:
        return DoubtfulAnswer(f"answered a job that cannot be done: {problem}")
    except Problem as problem:
        return WrongAnswer(f"answered a {job.kind} job with what cannot be read: {problem.message}")
    return done


def _check_envelope(job: Job, done: JobDone) -> None:
    if (done.job, done.kind) != (job.job, job.kind):
        seen = f"job {done.job[:32]!r} of kind {done.kind[:32]!r}"
        raise WrongAnswer(f"answered {seen}; asked was {job.job!r} of kind {job.kind!r}")
    if not 0.0 <= done.seconds < math.inf:
        raise WrongAnswer(f"says that a job took {done.seconds} s")


def _check_optimum(payload: bytes, answer: bytes) -> None:
    from factorbus.solver import chi2_at

    graph, optimum = codec.decode_graph(payload).batch, codec.decode_optimum(answer)
    if optimum.start not in (*STARTS, ""):
        raise WrongAnswer(f"answered a batch job from the start {optimum.start[:32]!r}; there are {', '.join(STARTS)}")
    _check_keys(_kinds(graph.variables), _kinds(optimum.variables), _kinds(graph.variables, fixed=False))
    if not math.isfinite(optimum.chi2) or not all(_is_finite(group) for group in optimum.variables):
        raise DoubtfulAnswer("answered a batch job with numbers that are not finite")
    chi2 = chi2_at(graph.variables, graph.factors, optimum.variables)
    if not abs(optimum.chi2 - chi2) <= _CHI2 * (1.0 + chi2):
        raise WrongAnswer(f"answered a batch job with χ² {optimum.chi2:.9g}, where its values have {chi2:.9g}")


def _is_finite(group: Variables) -> bool:
    return group.values is not None and bool(np.isfinite(group.values).all())


def _kinds(groups: tuple[Variables, ...], fixed: bool = True) -> dict[int, str]:
    """Kind by key; with those that are fixed, or without.  Raises WrongAnswer where a key comes twice."""
    kinds: dict[int, str] = {}
    for group in groups:
        if fixed or not group.fixed:
            keys = group.keys.tolist()
            if len(kinds.keys() | keys) < len(kinds) + len(keys):
                raise WrongAnswer("answered a batch job with a variable twice")
            kinds.update(dict.fromkeys(keys, group.kind))
    return kinds


def _check_keys(known: Mapping[int, str], told: Mapping[int, str], wanted: Mapping[int, str]) -> None:
    strange = [key for key, kind in told.items() if known.get(key) != kind]
    missing = wanted.keys() - told.keys()
    if strange or missing:
        what = f"{counted(len(missing), 'variable')} missing, {len(strange)} that the graph does not have"
        raise WrongAnswer(f"answered a batch job with {what}")


def _check_features(payload: bytes, answer: bytes) -> None:
    shard = decode_shard(payload)
    ask, done = decode_ask(shard.ask, ANSWER_LIMITS), decode_shard_done(answer)
    if (done.first, done.last) != (shard.first, shard.last):
        asked = f"{shard.first} to {shard.last}"
        raise WrongAnswer(f"answered features {done.first} to {done.last}; asked were {asked}")
    parts = _parts(ask, done)
    for name, (array, shape) in parts.items():
        if array is None or array.shape != shape:
            seen = "no" if array is None else f"{' × '.join(map(str, array.shape))}"
            raise WrongAnswer(f"answered {seen} {name}; wanted {' × '.join(map(str, shape))}")
    if not all(np.isfinite(array).all() for array, _ in parts.values()):
        raise DoubtfulAnswer("answered features with numbers that are not finite")
    if (done.y[:, :3] != ask.observations.state[:3]).any() or (done.y[:, 5] != ask.observations.rho).any():
        raise WrongAnswer("answered features of another camera, or with another prior of ρ")


def _parts(ask: Ask, done: ShardDone) -> dict[str, tuple[Any, tuple[int, ...]]]:
    """By name the arrays that an answer in this form has, and their shapes."""
    n, m, k = ask.observations.count, ask.observations.width, done.last - done.first
    blocks = sum(FEATURE * FEATURE * (n - i) for i in range(done.first, done.last))
    by_form = {
        "rows": {"rows": (FEATURE * k, m + FEATURE * n)},
        "half": {"cross": (FEATURE * k, m), "blocks": (blocks,)},
        "factored": {"turn": (k, 4), "own": (k, 3), "U": (FEATURE, m), "S": (3, 3)},
    }
    wanted = by_form[ask.form]
    if done.stored and ask.form == "rows" and ask.segment is not None:
        wanted = {}
    return {name: (getattr(done, name), shape) for name, shape in {"y": (k, FEATURE), **wanted}.items()}


_CHECKS: Mapping[str, Callable[[bytes, bytes], None]] = {"batch": _check_optimum, "idp": _check_features}
