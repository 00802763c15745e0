"""`factorbus kinds`: every kind, what one means, built in or one's own, and what a formula may do."""

import json

import pytest
from click.testing import CliRunner

from factorbus.cli.commands.kinds import command
from factorbus.cli.main import COMMANDS
from factorbus.cli.output.exits import Stopped
from factorbus.proto.expressions.operations import ABSENT, LEGEND, OPERATIONS
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.why_text import why_text


def ran(*arguments: str) -> str:
    done = CliRunner().invoke(command, [*arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def test_the_list_has_families_beside_the_kinds_in_tables() -> None:
    found = json.loads(ran("--json"))["kinds"]
    assert set(found) == {*FACTOR_KINDS, "linear_ROWS_KIND_KIND...", "imu_SAMPLES"}
    assert found["linear_ROWS_KIND_KIND..."] == "any: Σ Hₙ (xₙ ⊟ yₙ) + b"
    assert found["imu_SAMPLES"].startswith("se3, vector3, vector6, se3, vector3, vector6: W (log(")


@pytest.mark.parametrize("name", ["range_se2", "position_se3_frame_arm", "linear_3_se2_point2", "imu_7"])
def test_a_kind_that_is_built_in_is_shown_by_its_name(name: str) -> None:
    found = json.loads(ran(name, "--json"))["kinds"]
    kind = FACTOR_KINDS[name]
    assert (found["name"], found["variables"]) == (name, ", ".join(kind.connects))
    assert found["measured"] == kind.measured
    assert kind.residual in found["residual"]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("rnage_se2", "did you mean 'range_se2'"),
        ("linear_9_se2", "9 rows on 1 variable"),
        ("imu_0", "wanted a number of samples from 1 on"),
        ("f(a:se2,z:1)=headng(a)", "did you mean 'heading'"),
    ],
)
def test_a_kind_that_is_none_says_why(name: str, why: str) -> None:
    with pytest.raises(Stopped, match=why) as stopped:
        ran(name)
    assert stopped.value.code == "unknown_kind"


def test_a_built_in_kind_has_no_test_of_a_formula() -> None:
    done = CliRunner().invoke(command, ["range_se2", "--test"])
    assert done.exit_code == 2
    assert "range_se2 is a kind of the service" in done.output


def test_operations_have_what_they_take_and_what_there_is_not() -> None:
    told = json.loads(ran("--operations", "--json"))
    assert told["notes"] == [LEGEND, ABSENT]
    assert told["kinds"]["add(a,b)"] == "n, n → n: a + b"
    assert told["kinds"]["part(a,first,count)"].startswith("n → count: count numbers of a")
    assert len(told["kinds"]) == len(OPERATIONS)
    text = ran("--operations")
    assert LEGEND in text
    assert ABSENT in text


def test_why_has_the_name_of_an_own_kind_and_not_its_formula() -> None:
    factor = {"factor": 3, "kind": "near(a:se2,z:1)=subtract(heading(a),z)", "keys": [], "chi2": 1.0}
    told = why_text(7, {}, factor, {})
    assert "factor 3, near ()" in told
    assert "subtract" not in told


def test_the_list_of_commands_has_the_formats() -> None:
    for name, formats in (("save", ("g2o", "pyfg", "JRL", "TUM", "KITTI")), ("replay", ("g2o", "pyfg", "JRL"))):
        assert all(each in COMMANDS[name][1] for each in formats)
