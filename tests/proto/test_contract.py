"""`proto/README.md` says what the code does: every kind, problem, key and message field is in it."""

import json
import re
import runpy
from pathlib import Path
from typing import Any

import pytest

from factorbus.client import link
from factorbus.proto import interest, interest_codec, keys, messages, problems
from factorbus.proto.expressions.operations import OPERATIONS
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.protocol import known
from factorbus.proto.symbols import symbol
from factorbus.solver.modes import MODES

CONTRACT = (Path(__file__).parents[2] / "proto" / "README.md").read_text()
CLIENT_SIDE = {"bad_symbol", "bad_stamp", "bad_endpoint", "bad_information", "bad_setting", "not_converged", "problem"}


def every_problem(base: type[problems.Problem]) -> set[str]:
    """The codes of a part of the tree; Refused carries somebody else's."""
    below = {
        code for kind in base.__subclasses__() if kind.__module__ == base.__module__ for code in every_problem(kind)
    }
    return {base.code} | below


def test_every_kind_is_explained() -> None:
    vectors = [name for name, kind in VARIABLE_KINDS.items() if kind.is_vector]
    assert f"| `{vectors[0]}` … `{vectors[-1]}` |" in CONTRACT
    for name in [*VARIABLE_KINDS, *FACTOR_KINDS]:
        assert f"| `{name}` |" in CONTRACT or name in vectors


def test_the_table_of_factors_is_written_from_the_declarations() -> None:
    """`python proto/kinds_table.py` writes it."""
    script = runpy.run_path(str(Path(__file__).parents[2] / "proto" / "kinds_table.py"))
    assert script["found"](CONTRACT) == script["table"]()
    assert script["found"](CONTRACT, script["_OPERATIONS_HEAD"], 2) == script["operations"]()


def test_the_tutorial_lists_the_operations_with_what_they_take() -> None:
    tutorial = (Path(__file__).parents[2] / "docs" / "tutorials" / "own-factor.md").read_text(encoding="utf-8")
    rows = [" ".join(line.split()) for line in tutorial.splitlines()]
    for each in OPERATIONS.values():
        wanted = f"{each.signature()} {each.forms}: "
        assert sum(row.startswith(wanted) for row in rows) == 1, wanted


def test_every_code_is_explained() -> None:
    for code in every_problem(problems.Problem) - CLIENT_SIDE:
        assert f"`{code}`" in CONTRACT


@pytest.mark.parametrize(
    "message",
    [
        messages.Insert,
        messages.Accepted,
        messages.Estimate,
        messages.Delta,
        messages.MapGraph,
        messages.Chi2,
        messages.Job,
        messages.JobDone,
        messages.Optimum,
        messages.Variables,
        messages.Factors,
        messages.Change,
        interest_codec.AskInterest,
        interest_codec.InterestAnswer,
        interest_codec.InterestDelta,
        interest.Interest,
    ],
)
def test_every_field_is_explained(message: Any) -> None:
    names = set(message.__match_args__) - {"batch", "interest"}
    assert not {name for name in names if f"`{name}`" not in CONTRACT}


@pytest.mark.parametrize(
    ("key", "pattern"),
    [
        (keys.insert_key("m", "c"), "map/<map>/in/<client>"),
        (keys.ask_key("m", "chi2"), "map/<map>/ask/<question>"),
        (keys.delta_key("m"), "map/<map>/out/delta"),
        (keys.snapshot_key("m"), "map/<map>/out/snapshot"),
        (keys.event_key("m"), "map/<map>/out/event"),
        (keys.channel_key("m", "interest-0123456789abcdef"), "map/<map>/out/interest-<id>"),
        (keys.service_token("m", "s"), "map/<map>/live/service/<id>"),
        (keys.client_token("m", "c"), "map/<map>/live/client/<client>"),
        (keys.admin_key("maps"), "admin/maps"),
        (keys.job_key("w"), "worker/<id>/job"),
        (keys.worker_token("w", 2), "worker/<id>/live/<slots>"),
        (keys.features_key("s"), "features/<service>/ask"),
        (keys.features_token("s"), "features/<service>/live"),
    ],
)
def test_every_key_is_where_the_contract_says(key: str, pattern: str) -> None:
    assert f"`{pattern}`" in CONTRACT
    assert re.fullmatch(f"{keys.PREFIX}/" + re.sub("<[a-z]+>", "[^/]+", pattern), key)


def test_the_example_of_a_key_is_right() -> None:
    assert symbol("x", 12) == 0x78000000_0000000C
    assert "`0x78000000_0000000c`" in CONTRACT


def test_the_bytes_shown_are_those_of_the_golden_insert() -> None:
    """The hexadecimal of the walk-through, ellipses and repetitions aside, is in the message in that order."""
    golden = (Path(__file__).parents[2] / "proto" / "vectors" / "insert.msgpack").read_bytes()
    walk = CONTRACT.split("```")[1]
    at = 0
    for token in re.findall(r'"([a-z0-9_]+)"|((?:\b[0-9a-f]{2}\b ?){8})', walk):
        part = token[0].encode() or bytes.fromhex(token[1])
        found = golden.find(part, at)
        assert found >= 0, token
        at = found + len(part)
    assert at > len(golden) - 10


def test_every_question_is_explained() -> None:
    for question in keys.QUESTIONS:
        assert f"| `{question}` |" in CONTRACT


def test_settings_of_the_session_are_those_of_the_client() -> None:
    """§14 names the keys of Zenoh's configuration, with the values that the Python client has."""
    table = CONTRACT.split("by the keys of its configuration:")[1].split("## 15")[0]
    told = {key: json.loads(value) for key, value in re.findall(r"^\| `([a-z_/]+)` \| `([^`]+)` \|", table, re.M)}
    ours = link.session_settings(["tcp/127.0.0.1:1"])
    assert set(told) == set(ours) - {
        "connect/endpoints", "scouting/multicast/enabled", "scouting/gossip/enabled",
    }  # fmt: skip
    assert told == {key: ours[key] for key in told}
    assert "`scouting/multicast/enabled` and `scouting/gossip/enabled` false" in table


def test_what_a_service_knows_is_explained() -> None:
    section = CONTRACT.split("**What a service knows**")[1].split("**Another version**")[0]
    for name in known():
        assert f"`{name}`" in section
    assert set(known()["insert"]) == (set(messages.Insert.__match_args__) - {"batch"}) | {"variables", "factors"}


def test_modes_and_states_are_listed() -> None:
    section = CONTRACT.split("## 9.")[1].split("## 10.")[0]
    for name in (*MODES, "open", "blocked", "damaged", "differs", "other_version", "unreadable"):
        assert f"`{name}`" in section
