"""Edits of maps: one after the other, by `Changes` alone, so that each is journalled under the name of who made it."""

import asyncio
import math
from typing import Any

from factorbus.client.merging import Fitted, as_trusted
from factorbus.client.renaming_kinds import saying_how_to_rename
from factorbus.gateway.edit_log import EditLog
from factorbus.gateway.edit_plans import plan_edit
from factorbus.gateway.edit_requests import EditRequest
from factorbus.gateway.maps import Joined, JoinedMaps
from factorbus.gateway.merge_plans import plan_merge
from factorbus.gateway.people import OPERATOR, NotAllowed, Person
from factorbus.gateway.steps import EditPlan, EditStep
from factorbus.proto.asking import AskWhy
from factorbus.proto.messages import Accepted, MapGraph
from factorbus.proto.problems import WrongEpoch
from factorbus.proto.symbols import format_symbol

_EDIT_S = 60.0  # for the answer to an edit, of a large map that has to converge anew
_PAIRS = 20  # anchors of a merge whose misfit is asked for
_DENIED = (
    "access control on the bus lets this gateway follow the map and not change it; start it with --zenoh and --client "
    "of an operator or a front end"
)


class Editing:
    """What edits have been made in each map, and how the next is."""

    def __init__(self, maps: JoinedMaps) -> None:
        self._maps = maps
        self._logs: dict[str, EditLog] = {}
        self._passes: set[tuple[str, int]] = set()  # maps, with their epochs, that inserts have reached

    async def why_not(self, person: Person, name: str) -> str:
        """Why this person cannot edit the map; empty: they can.  Raises Refused, Unavailable, UnknownMap."""
        if person.role != OPERATOR:
            return person.why
        async with self._maps.using(name) as joined:
            this = (name, joined.map.estimate.epoch)
            if this not in self._passes:
                if not await asyncio.to_thread(self._maps.bus.may_insert, name):
                    return _DENIED
                self._passes.add(this)
        return ""

    async def log(self, name: str) -> EditLog:
        """Of the map as it is; of one that was created anew an empty one."""
        async with self._maps.using(name) as joined:
            return self._log(name, joined.map.estimate.epoch)

    async def edit(self, name: str, person: Person, request: EditRequest) -> dict[str, Any]:
        """Make an edit, and say what came of it.  Raises Problem: nothing was changed."""
        if why := await self.why_not(person, name):
            raise NotAllowed(f"{why}; nothing was changed")
        async with self._maps.using(name) as joined:
            log = self._log(name, joined.map.estimate.epoch)
            async with log.making:
                if request.edit == "undo":
                    return await self._undo(joined, log, person, request.fields["number"])
                if request.edit == "merge":
                    return await self._merge(joined, log, person, request)
                plan = plan_edit(request, await _graph_now(joined), log)
                return (await self._make(joined, log, person, plan))[1]

    async def _undo(self, joined: Joined, log: EditLog, person: Person, number: int) -> dict[str, Any]:
        edit = log.last(number)
        before = await _chi2(joined)
        accepted = await self._send(joined, log, person, edit.back)
        log.made(edit.back, accepted.first_factor)
        edit.undone = person.name
        return edit.document() | _outcome(accepted, before)

    async def _merge(self, joined: Joined, log: EditLog, person: Person, request: EditRequest) -> dict[str, Any]:
        async with self._maps.using(request.fields["other"]) as theirs:
            other = await _graph_now(theirs)
        graph = await _graph_now(joined)
        plan, fitted, letters = await asyncio.to_thread(plan_merge, request, graph, other)
        with saying_how_to_rename():
            new, made = await self._make(joined, log, person, plan)
        return made | {"merge": await _verdict(joined, fitted, new) | {"letters": dict(letters)}}

    async def _make(
        self, joined: Joined, log: EditLog, person: Person, plan: EditPlan
    ) -> tuple[list[int], dict[str, Any]]:
        """The ids of what is new, and what came of it."""
        before = await _chi2(joined)
        accepted = await self._send(joined, log, person, plan.step)
        new = log.made(plan.step, accepted.first_factor)
        edit = log.add(plan.what, person.name, accepted.revision, plan.back(new), new)
        return new, edit.document() | _outcome(accepted, before)

    async def _send(self, joined: Joined, log: EditLog, person: Person, step: EditStep) -> Accepted:
        return await asyncio.to_thread(self._insert, joined.map.name, log, person, step)

    def _insert(self, name: str, log: EditLog, person: Person, step: EditStep) -> Accepted:
        bus = self._maps.bus
        with bus.map(name, mirror=False, create=False, client=f"{bus.client}-{person.name}") as own:
            if own.epoch != log.epoch:
                raise WrongEpoch(log.epoch, own.epoch)
            batch = as_trusted(step.batch()) if own.closures != "trust" else step.batch()
            return own.insert(batch, changes=step.changes(log.called), settle=True, timeout_s=_EDIT_S)

    def _log(self, name: str, epoch: int) -> EditLog:
        log = self._logs.get(name)
        if log is None or log.epoch != epoch:
            log = self._logs[name] = EditLog(epoch)
        return log


async def _graph_now(joined: Joined) -> MapGraph:
    """Asked for anew: what others look at may be a step behind the edit that was made last."""
    return await asyncio.wrap_future(joined.map.ask.graph(None))


async def _chi2(joined: Joined) -> float:
    return (await asyncio.wrap_future(joined.map.ask.chi2(False, None))).chi2


def _outcome(accepted: Accepted, before: float) -> dict[str, Any]:
    chi2 = accepted.report.get("chi2")
    return {"at_revision": accepted.revision, "chi2_before": before, "chi2": chi2}


async def _verdict(joined: Joined, fitted: Fitted, new: list[int]) -> dict[str, Any]:
    """What was merged, and how well each pair fits afterwards: misfit = √(rᵀ Ω r / dim)."""
    pairs = []
    for factor in new[len(new) - fitted.anchors :][:_PAIRS]:
        found = (await asyncio.wrap_future(joined.map.uncertainty.ask.why(AskWhy(None, factor), None))).factor
        keys = [format_symbol(key) for key in found["keys"]]
        pairs.append({"factor": factor, "keys": keys, "misfit": math.sqrt(found["chi2"] / found["dims"])})
    return {
        "variables": fitted.batch.variable_count,
        "factors": fitted.batch.factor_count,
        "left_out": dict(fitted.left_out),
        "frame": fitted.frame.tolist(),
        "pairs": pairs,
    }
