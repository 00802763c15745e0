"""From an edit that is asked for to the step that makes it and the one that undoes it."""

from collections.abc import Callable, Mapping

import numpy as np

from factorbus.client import Draft
from factorbus.gateway.edit_log import EditLog
from factorbus.gateway.edit_requests import EditRequest
from factorbus.gateway.steps import EditPlan, EditStep, ids_of
from factorbus.proto.kinds import VARIABLE_KINDS, name_of_kind
from factorbus.proto.messages import Factors, MapGraph, Variables
from factorbus.proto.problems import BadOption, BadShape, Refused
from factorbus.proto.roles import pick_factors
from factorbus.proto.symbols import format_symbol
from factorbus.wording import counted

_FEW = 3  # factors or keys that are named
# What says where a variable is, whole and its place alone, by its kind.
_PRIORS = {"se2": "prior_se2", "se3": "prior_se3", "point2": "prior_point2", "point3": "prior_point3"}
_ANCHORS = _PRIORS | {"se2": "position_se2", "se3": "position_se3"}


def plan_edit(request: EditRequest, graph: MapGraph, log: EditLog) -> EditPlan:
    """Of any edit but undo and merge.  Raises BadOption, BadShape, Refused as the service would."""
    return _PLANS[request.edit](request, graph, log)


def _reject(request: EditRequest, graph: MapGraph, _: EditLog) -> EditPlan:
    rows = _factors(graph, request.fields["factors"])
    return EditPlan(f"rejected {_called(rows)}", EditStep(reject=rows), lambda _: EditStep(restore=rows))


def _restore(request: EditRequest, _: MapGraph, log: EditLog) -> EditPlan:
    rows = []
    for each in request.fields["factors"]:
        row = log.rejected(each)
        if row is None:
            raise BadOption("restore", f"factor {each}", "a factor that was rejected here and is not back")
        rows.append(row)
    back = tuple(rows)
    return EditPlan(f"restored {_called(back)}", EditStep(restore=back), lambda _: EditStep(reject=back))


def _accept_closures(request: EditRequest, _: MapGraph, __: EditLog) -> EditPlan:
    ids = tuple(request.fields["factors"])
    what = f"accepted {_closures(ids)}"
    return EditPlan(what, EditStep(accept=ids), lambda _: EditStep(disbelieve=ids))


def _reject_closures(request: EditRequest, _: MapGraph, __: EditLog) -> EditPlan:
    ids = tuple(request.fields["factors"])
    what = f"rejected {_closures(ids)}"
    return EditPlan(what, EditStep(disbelieve=ids), lambda _: EditStep(accept=ids))


def _weigh(request: EditRequest, graph: MapGraph, _: EditLog) -> EditPlan:
    rows, weight = _factors(graph, request.fields["factors"]), request.fields["weight"]
    ids = tuple(ids_of(rows))
    step, back = (EditStep(weigh=(ids, (each,) * len(ids))) for each in (weight, 1.0 / weight))
    return EditPlan(f"weighed {_called(rows)} × {weight:g}", step, lambda _: back)


def _fix(request: EditRequest, graph: MapGraph, _: EditLog) -> EditPlan:
    keys = _keys_that_are(graph, request, fixed=False)
    return EditPlan(f"held {_named(keys)}", EditStep(fix=keys), lambda _: EditStep(free=keys))


def _free(request: EditRequest, graph: MapGraph, _: EditLog) -> EditPlan:
    keys = _keys_that_are(graph, request, fixed=True)
    return EditPlan(f"let go of {_named(keys)}", EditStep(free=keys), lambda _: EditStep(fix=keys))


def _prior(request: EditRequest, graph: MapGraph, _: EditLog) -> EditPlan:
    key, sigmas = request.fields["key"], request.fields["sigmas"]
    kind = _variable(graph, key).kind
    made = _kind_for("prior", kind, _PRIORS)
    dim = VARIABLE_KINDS[kind].dim
    if len(sigmas) != dim:
        raise BadShape("prior: sigmas", len(sigmas), f"{dim}, metres and radians")
    draft = Draft().factor(made, [key], request.fields["value"], sigmas=sigmas)
    return _inserting(f"put {format_symbol(key)} to {_listed(request.fields['value'])} with a prior", draft)


def _anchor(request: EditRequest, graph: MapGraph, _: EditLog) -> EditPlan:
    key, place, sigma = (request.fields[name] for name in ("key", "place", "sigma"))
    kind = _variable(graph, key).kind
    made = _kind_for("anchor", kind, _ANCHORS)
    dim = 2 if kind in ("se2", "point2") else 3
    if len(place) != dim:
        raise BadShape("anchor: place", len(place), f"{dim} coordinates, metres")
    lever = [0.0] * dim if made.startswith("position") else []  # the place of the pose itself, not of an antenna on it
    draft = Draft().factor(made, [key], [*place, *lever], sigmas=[sigma] * dim)
    return _inserting(f"anchored {format_symbol(key)} at {_listed(place)}, σ {sigma:g} m", draft)


def _inserting(what: str, draft: Draft) -> EditPlan:
    return EditPlan(what, EditStep(insert=draft.batch()), lambda new: EditStep(remove=tuple(new)))


_PLANS: Mapping[str, Callable[[EditRequest, MapGraph, EditLog], EditPlan]] = {
    "reject": _reject, "restore": _restore, "accept_closures": _accept_closures, "reject_closures": _reject_closures,
    "weigh": _weigh, "fix": _fix, "free": _free, "prior": _prior,
    "anchor": _anchor,
}  # fmt: skip


def _factors(graph: MapGraph, ids: list[int]) -> tuple[Factors, ...]:
    """Rows of the graph.  Raises Refused where one is not there."""
    found = []
    for group in graph.batch.factors:
        chosen = np.isin(ids_of([group]), ids)
        if chosen.any():
            found.append(pick_factors(group, chosen))
    missing = sorted(set(ids) - set(ids_of(found)))
    if missing:
        told = f"there is no factor {missing[0]}, or not any more; nothing was done. Select it again"
        raise Refused("unknown_factor", told, {"factor": missing[0]})
    return tuple(found)


def _variable(graph: MapGraph, key: int) -> Variables:
    """The group that a variable is in.  Raises Refused where it is not there."""
    for group in graph.batch.variables:
        if key in group.keys:
            return group
    told = f"there is no variable {format_symbol(key)}, or not any more; nothing was done"
    raise Refused("unknown_variable", told, {"key": key})


def _keys_that_are(graph: MapGraph, request: EditRequest, fixed: bool) -> tuple[int, ...]:
    keys = tuple(key for key in request.fields["keys"] if _variable(graph, key).fixed == fixed)
    if not keys:
        seen = f"{_named(tuple(request.fields['keys']))}, {'estimated' if fixed else 'held'} already"
        raise BadOption(request.edit, seen, "a variable that is " + ("held" if fixed else "estimated"))
    return keys


def _kind_for(what: str, kind: str, kinds: Mapping[str, str]) -> str:
    if kind not in kinds:
        raise BadOption(what, f"a variable of kind {kind}", f"one of {', '.join(kinds)}")
    return kinds[kind]


def _called(groups: tuple[Factors, ...]) -> str:
    each = [
        f"{name_of_kind(group.kind)} ({', '.join(map(format_symbol, keys))})"
        for group in groups
        for keys in group.keys.tolist()
    ]
    more = f" and {len(each) - _FEW} more" if len(each) > _FEW else ""
    return f"{counted(len(each), 'factor')}: {', '.join(each[:_FEW])}{more}" if len(each) > 1 else each[0]


def _closures(ids: tuple[int, ...]) -> str:
    more = f" and {len(ids) - _FEW} more" if len(ids) > _FEW else ""
    return f"{'closure' if len(ids) == 1 else 'closures'} {', '.join(map(str, ids[:_FEW]))}{more}"


def _named(keys: tuple[int, ...]) -> str:
    more = f" and {len(keys) - _FEW} more" if len(keys) > _FEW else ""
    return ", ".join(map(format_symbol, keys[:_FEW])) + more


def _listed(numbers: list[float]) -> str:
    return f"({', '.join(f'{each:.3f}' for each in numbers)})"
