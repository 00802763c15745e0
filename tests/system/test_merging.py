"""Maps of two robots become one, over the bus: what was driven in two halves is what would have been driven in one."""

import asyncio
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from processes import Process

from factorbus.client import (
    AbsoluteFactors,
    CannotMerge,
    Changes,
    Draft,
    KeyCollision,
    Map,
    NoAnchor,
    Refused,
    aio,
    connect,
)
from factorbus.client.merging import fit_into
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import format_symbol, symbol
from factorbus.simulate import WORLDS

X, Y, L, M = (symbol(letter, 0) for letter in "xylm")
LETTERS = {"x": "y", "l": "m"}
SIGMAS = (0.1, 0.1, 0.05)


def letters_of(batch: Batch) -> dict[str, str]:
    """New letters for those that its variables have."""
    there = {format_symbol(int(key))[0] for group in batch.variables for key in group.keys}
    return {old: new for old, new in LETTERS.items() if old in there}


@dataclass(frozen=True)
class Halves:
    """A drive as two robots would have made it, who know of each other only what `between` says.

    The second's keys have y and m in `between` and in `whole`: all of it, as one map would have it.
    """

    first: Batch
    second: Batch
    between: Batch
    whole: Batch


def halves(world: str, poses: int) -> Halves:
    """From the middle on, poses and points are the second robot's."""
    steps = [step.batch for step in WORLDS[world](poses, 3)]
    kind = steps[0].variables[0].kind
    own = np.concatenate([group.keys for step in steps[poses // 2 :] for group in step.variables])
    renamed = {int(key): int(key) - X + Y if key >= X else int(key) - L + M for key in own}
    origin = np.array([[0.0] * 3 if kind == "se2" else [0.0] * 6 + [1.0]])
    start = Variables(kind, own[:1], origin, True)
    parts: dict[str, list[Factors]] = {"first": [], "second": [], "between": []}
    for group in (group for step in steps for group in step.factors):
        for n in range(len(group.keys)):
            row = group._replace(
                keys=group.keys[n : n + 1], measured=group.measured[n : n + 1], information=group.information[n : n + 1]
            )
            mine = np.isin(row.keys, own)
            parts["second" if mine.all() else "between" if mine.any() else "first"].append(row)

    def under_new_keys(rows: list[Factors]) -> list[Factors]:
        return [row._replace(keys=np.vectorize(lambda key: renamed.get(key, key))(row.keys)) for row in rows]

    variables = [group for step in steps[: poses // 2] for group in step.variables]
    others = [group for step in steps[poses // 2 :] for group in step.variables][1:]
    theirs = [Variables(g.kind, np.array([renamed[int(key)] for key in g.keys])) for g in (start, *others)]
    between = under_new_keys(parts["between"])
    # In the order in which a value follows from the first factor that reaches a variable.
    factors = (*parts["first"], *between, *under_new_keys(parts["second"]))
    return Halves(
        gathered((*variables,), parts["first"]),
        gathered((start, *others), parts["second"]),
        gathered((), between),
        gathered((*variables, *theirs), factors),
    )


def gathered(variables: tuple[Variables, ...], factors: Any) -> Batch:
    """With few groups: a message may have 256."""
    kinds = {(g.kind, g.values is not None, g.fixed): None for g in variables}
    groups = []
    for kind, valued, fixed in kinds:
        mine = [g for g in variables if (g.kind, g.values is not None, g.fixed) == (kind, valued, fixed)]
        values = np.concatenate([g.values for g in mine]) if valued else None
        groups.append(Variables(kind, np.concatenate([g.keys for g in mine]), values, fixed))
    made = []
    for kind in dict.fromkeys(row.kind for row in factors):
        rows = [row for row in factors if row.kind == kind]
        columns = (np.concatenate([getattr(row, c) for row in rows]) for c in ("keys", "measured", "information"))
        made.append(Factors(kind, *columns))
    return Batch(tuple(groups), tuple(made))


def values(joined: Map) -> dict[int, np.ndarray]:
    return {int(k): row for g in joined.ask_estimate().variables for k, row in zip(g.keys, g.values, strict=True)}


def farthest(a: dict[int, np.ndarray], b: dict[int, np.ndarray]) -> float:
    """The largest difference of two estimates: angles wrapped, quaternions up to their sign."""
    assert a.keys() == b.keys()
    worst = 0.0
    for key, row in a.items():
        off = row - b[key]
        if row.size == 3 and key >= X:
            off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
        if row.size == 7 and row[3:] @ b[key][3:] < 0:
            off[3:] = row[3:] + b[key][3:]
        worst = max(worst, float(np.abs(off).max()))
    return worst


@pytest.mark.parametrize(("world", "poses"), [("manhattan", 240), ("city_trees", 150), ("sphere", 120)])
def test_two_halves_merged_are_the_map_that_was_built_in_one(endpoint: str, world: str, poses: int) -> None:
    given = halves(world, poses)
    assert given.between.factor_count > 3
    with connect(endpoint, client="robots", timeout_s=60) as bus:
        names = [f"{part}-{world.replace('_', '-')}" for part in ("one", "first", "second")]
        one, first, second = (bus.map(name, mirror=False) for name in names)
        one.insert(given.whole, settle=True)
        first.insert(given.first, settle=True)
        second.insert(given.second, settle=True)
        before, alone = values(second), values(first)
        merged = first.merge(second, anchors=given.between, letters=letters_of(given.second), settle=True)
        assert merged.fitted.left_out == {"fixed": 1}
        assert merged.accepted.report["new_factors"] == given.second.factor_count + given.between.factor_count
        assert farthest(values(first), values(one)) < 1e-6
        assert first.chi2().chi2 == pytest.approx(one.chi2().chi2, rel=1e-9)
        after = values(second)
        assert all(np.array_equal(after[key], row) for key, row in before.items())
        first.change(Changes().undo(merged.fitted.batch, merged.accepted), settle=True)
        assert farthest(values(first), alone) < 1e-6, "and it can be undone"


def test_a_map_of_another_service_is_merged_on_the_command_line(endpoint: str, spawn: Callable[..., Process]) -> None:
    other = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--no-warm").ready()[0]
    with connect(endpoint, client="a", timeout_s=60) as here, connect(other, client="b", timeout_s=60) as there:
        hall, yard = here.map("merged-hall"), there.map("yard")
        for n, joined in enumerate((hall, yard)):
            joined.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
            for i in range(1, 6):
                step = Draft().se2(f"x{i}").between_se2(f"x{i - 1}", f"x{i}", (1, 0, 0.1 - 0.2 * n), sigmas=SIGMAS)
                joined.insert(step)
        at = ("--connect", endpoint, "--json")
        how = ("--from", other, "--letter", "x=y", "--anchor", "x3", "y2", "0,2,-1.5", "--sigmas", "0.1,0.1,0.05")
        refused = json.loads(command("change", "merge", "merged-hall", "yard", *how[:2], *how[4:], *at, code=5))
        assert refused["problem"]["code"] == "key_collision"
        told = json.loads(command("change", "merge", "merged-hall", "yard", *how, "--settle", *at))
        assert (told["variables"], told["factors"], told["anchors"], told["left_out_fixed"]) == (6, 6, 1, 1)
        hall.estimate.wait_for(told["revision"])
        assert told["chi2"] == pytest.approx(0, abs=1e-9)
        np.testing.assert_allclose(hall.estimate["y0"], told["frame"], atol=1e-9)
        frame = ("--from", other, "--letter", "x=z", "--frame", "5,5,1", "--sigmas", "0.1,0.1,0.05")
        told = json.loads(command("change", "merge", "merged-hall", "yard", *frame, *at))
        hall.estimate.wait_for(told["revision"])
        np.testing.assert_allclose(hall.estimate["z0"], (5, 5, 1), atol=1e-9)


def test_what_is_refused_changes_nothing(endpoint: str) -> None:
    with connect(endpoint, client="robots", timeout_s=60) as bus:
        ours, theirs = bus.map("refusing"), bus.map("refused")
        for joined in (ours, theirs):
            joined.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
            joined.insert(Draft().se2("x1").between_se2("x0", "x1", (1, 0, 0), sigmas=SIGMAS))
        here, graph = ours.ask_estimate(), theirs.graph()
        link = Draft().between_se2("x1", "y0", (1, 0, 0), sigmas=SIGMAS)
        letters = {"x": "y"}
        with pytest.raises(KeyCollision):
            ours.merge(theirs, anchors=link)
        with pytest.raises(NoAnchor):
            ours.merge(theirs, letters=letters)
        with pytest.raises(NoAnchor, match="the anchors name x7"):
            ours.merge(theirs, letters=letters, anchors=link.between_se2("x7", "y1", (0, 0, 0), sigmas=SIGMAS))
        theirs.insert(Draft().position_se2("x1", (1, 0), sigmas=(1, 1)))
        with pytest.raises(AbsoluteFactors):
            ours.merge(theirs, letters=letters, frame=(1, 1, 1), sigmas=SIGMAS)
        theirs.insert(Draft().se2("x5", (9, 9, 0), fixed=True))  # an island
        with pytest.raises(Refused) as refused:
            ours.merge(theirs, letters=letters, frame=(1, 1, 1), sigmas=SIGMAS, absolute="leave_out")
        assert refused.value.code == "underconstrained"
        assert ours.stats()["revision"] == here.revision == 2
        good = fit_into(here, graph, frame=(1, 1, 1), sigmas=SIGMAS, letters=letters)
        assert ours.insert(good.batch).revision == 3
        with pytest.raises(Refused) as refused:  # somebody was quicker
            ours.insert(good.batch)
        assert refused.value.code == "duplicate_variable"
        assert ours.stats()["revision"] == 3


def test_one_name_for_two_kinds_is_renamed_and_vectors_alone_are_inserted(endpoint: str) -> None:
    def wheel(name: str, factor: float) -> str:
        return f"{name}(a:se2,b:se2,z:1)=subtract(multiply(norm(subtract(position(a),position(b))),{factor}),z)"

    with connect(endpoint, client="robots", timeout_s=60) as bus:
        ours, theirs, vectors = (bus.map(name) for name in ("wheels-ours", "wheels-theirs", "wheels-vectors"))
        for joined, factor in ((ours, 2.5), (theirs, 3.5)):
            draft = Draft().se2("x0", (0, 0, 0), fixed=True).se2("x1").between_se2("x0", "x1", (1, 0, 0), sigmas=SIGMAS)
            joined.insert(draft)
            joined.insert(Draft().factor(wheel("wheel", factor), ("x0", "x1"), [factor], sigmas=[0.1]))
        how = {"letters": {"x": "y"}, "anchors": Draft().between_se2("x1", "y0", (1, 0, 0), sigmas=SIGMAS)}
        with pytest.raises(
            Refused, match=r"nothing was merged\. Give .*rename_kinds\(other\.graph\(\), {'wheel'"
        ) as refused:
            ours.merge(theirs, **how)
        assert refused.value.code == "kind_taken"
        line = ("--letter", "x=y", "--anchor", "x1", "y0", "1,0,0", "--sigmas", "0.1,0.1,0.05", "--connect", endpoint)
        said = command("change", "merge", "wheels-ours", "wheels-theirs", *line, code=5)
        assert "nothing was merged. Give the kind of OTHER another name, such as --kind wheel=wheel_2" in said
        told = json.loads(
            command("change", "merge", "wheels-ours", "wheels-theirs", *line, "--kind", "wheel=wheel_2", "--json")
        )
        assert told["chi2"] == pytest.approx(0, abs=1e-9)
        kinds = {group.kind for group in ours.graph().batch.factors}
        assert kinds == {"between_se2", wheel("wheel", 2.5), wheel("wheel_2", 3.5)}
        vectors.insert(Draft().vector("b0", (1, 2)).linear(["b0"], [(1, 2)], [np.eye(2)], (0, 0), sigmas=[1, 1]))
        with pytest.raises(CannotMerge, match=r"insert its graph\(\)\.batch"):
            ours.merge(vectors, **how)
        ours.insert(vectors.graph().batch)
        assert ours.graph().batch.factor_count == 6


def test_maps_of_one_frame_keep_what_they_know_of_it(endpoint: str) -> None:
    def drive(letter: str, joined: Map, x: float) -> None:
        for i in range(4):
            step = Draft().se2(f"{letter}{i}", (x + i, 0, 0) if i == 0 else None)
            step.position_se2(f"{letter}{i}", (x + i + 0.01 * i * i, 0.02 * i), sigmas=(0.5, 0.5))
            if i == 0:
                step.heading_se2(f"{letter}0", 0.0, sigmas=(0.1,))
            else:
                step.between_se2(f"{letter}{i - 1}", f"{letter}{i}", (1, 0, 0), sigmas=SIGMAS)
            joined.insert(step)

    with connect(endpoint, client="gps", timeout_s=60) as bus:
        one, first, second = (bus.map(name, mirror=False) for name in ("gps-one", "gps-first", "gps-second"))
        drive("x", one, 0)
        drive("y", one, 7)
        drive("x", first, 0)
        drive("x", second, 7)
        meeting = Draft().between_se2("x3", "y0", (4.1, 0.1, 0), sigmas=SIGMAS)
        one.insert(meeting, settle=True)
        with pytest.raises(AbsoluteFactors):
            first.merge(second, letters={"x": "y"}, anchors=meeting)
        merged = first.merge(second, letters={"x": "y"}, anchors=meeting, absolute="keep", settle=True)
        assert merged.fitted.left_out == {}
        assert farthest(values(first), values(one)) < 1e-6


def test_losses_marginals_and_asyncio(endpoint: str) -> None:
    """A marginal of relative poses goes along, turned with its frame; a factor keeps its loss."""

    async def run() -> tuple[Any, dict[int, np.ndarray]]:
        async with aio.connect(endpoint, client="aio", timeout_s=60) as bus, bus.map("aio-first") as first:
            async with bus.map("aio-second") as second:
                for joined in (first, second):
                    step = Draft().se2("x0", (0, 0, 0), fixed=True)
                    for i in range(1, 6):
                        step.se2(f"x{i}").between_se2(f"x{i - 1}", f"x{i}", (1, 0.1, 0.4), sigmas=SIGMAS)
                    step.between_se2("x1", "x5", (1.9, 2.7, 1.7), sigmas=SIGMAS, loss=("huber", 1.0))
                    await joined.insert(step, settle=True)
                await second.change(Changes().marginalize("x3"), settle=True)
                before = {
                    int(k): r
                    for g in (await second.ask_estimate()).variables
                    for k, r in zip(g.keys, g.values, strict=True)
                }
                link = Draft().between_se2("x2", "y0", (3, 1, 2.5), sigmas=SIGMAS)
                merged = await first.merge(second, anchors=link, letters={"x": "y"}, settle=True)
            estimate = await first.ask_estimate()
            after = {int(k): r for g in estimate.variables for k, r in zip(g.keys, g.values, strict=True)}
            graph = await first.graph()
            assert sorted(g.kind for g in graph.batch.factors if g.loss) == ["between_se2"]
            assert sum(g.keys.size // 2 for g in graph.batch.factors if g.loss) == 2
            assert [g.keys.tolist() for g in graph.batch.factors if g.kind == "linear_3_se2_se2"] == [[[Y + 2, Y + 4]]]
            T = merged.fitted.frame
            turn = np.array([[np.cos(T[2]), -np.sin(T[2])], [np.sin(T[2]), np.cos(T[2])]])
            return T, {k: after[k - X + Y][:2] - (turn @ row[:2] + T[:2]) for k, row in before.items()}

    _, apart = asyncio.run(run())
    assert len(apart) == 5
    assert max(np.abs(row).max() for row in apart.values()) < 1e-6, "it is as it was, but for where it is"


def command(*arguments: str, code: int = 0) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "factorbus.cli", *arguments], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout or done.stderr
