"""What `factorbus ask` and `factorbus change` show of a map: names and units of numbers, and of nothing a sentence."""

import json

import numpy as np
import pytest

from factorbus.cli.main import main
from factorbus.cli.output.exits import OK, REFUSED, USAGE
from factorbus.client import Draft, connect

SIGMAS = (0.1, 0.2, 0.05)


def shown(capsys: pytest.CaptureFixture[str], endpoint: str, *words: str, code: int = OK) -> str:
    capsys.readouterr()
    assert main([*words, "--connect", endpoint]) == code
    return capsys.readouterr().out


def walked() -> Draft:
    draft = Draft().se2("x0", (0, 0, 0), fixed=True).point2("l0")
    for n in range(1, 6):
        draft.se2(f"x{n}").between_se2(f"x{n - 1}", f"x{n}", (1, 0, 0.2), sigmas=SIGMAS)
    return draft.landmark_se2("x2", "l0", (1, 1), sigmas=(0.1, 0.1))


def test_a_covariance_says_what_its_numbers_are(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    with connect(endpoint, timeout_s=60) as bus, bus.map("covered") as covered:
        covered.insert(walked(), settle=True)
        sigmas, joint = np.sqrt(covered.uncertainty.joint("x5").diagonal()), covered.uncertainty.joint(["l0", "x5"])
    x, y, theta = (f"{sigma:.4g}" for sigma in sigmas)
    for words in (["x5"], ["--last"]):
        said = shown(capsys, endpoint, "ask", "covariance", "covered", *words)
        assert f"x5  x {x} m  y {y} m  theta {theta} rad" in " ".join(said.replace("   ", "  ").split("\n"))
    said = shown(capsys, endpoint, "ask", "covariance", "covered", "l0", "x5", "--joint").splitlines()
    assert said[1].split() == ["l0", "x", "l0", "y", "x5", "x", "x5", "y", "x5", "theta"]
    assert said[6].split() == ["x5", "theta", "rad", *(f"{number:.6g}" for number in joint[4])]
    told = json.loads(shown(capsys, endpoint, "ask", "covariance", "covered", "l0", "x5", "--joint", "--json"))
    assert told["kinds"] == ["point2", "se2"]
    assert [tuple(each.values()) for each in told["tangent"]] == [
        ("l0", "x", "m"), ("l0", "y", "m"), ("x5", "x", "m"), ("x5", "y", "m"), ("x5", "theta", "rad"),
    ]  # fmt: skip
    (block,) = json.loads(shown(capsys, endpoint, "ask", "covariance", "covered", "--last", "--json"))["blocks"]
    assert block["keys"] == ["x5"]
    assert [each["name"] for each in block["tangent"]] == ["x", "y", "theta"]
    assert "of the second as seen from the first" in shown(
        capsys, endpoint, "ask", "covariance", "covered", "x1", "x5", "--relative"
    )
    said = shown(capsys, endpoint, "ask", "why", "covered", "x5")
    assert f"x {x} m  y {y} m  theta {theta} rad" in said
    assert "(x y (metres), theta (radians))" in said


def test_of_nothing_there_is_a_sentence(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    with connect(endpoint, timeout_s=60) as bus:
        with bus.map("bare") as bare:
            bare.insert(Draft().point2("l0", (1, 2), fixed=True))
        bus.create("untouched")
        bus.create("tested", closures="test")
    said = shown(capsys, endpoint, "ask", "why", "bare", "l0")
    assert "No factor is on l0: it is fixed where it is." in said
    assert "Its factors" not in said
    assert "There is no variable in the map" in shown(capsys, endpoint, "ask", "covariance", "untouched")
    assert "There is no variable in the map" in shown(capsys, endpoint, "ask", "components", "untouched")
    assert "no factor in the map closes a loop" in shown(capsys, endpoint, "ask", "repair", "bare")
    assert "no factor in the map closes a loop" in shown(capsys, endpoint, "ask", "suspects", "tested")


def test_poses_are_marginalized_from_a_shell(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    with connect(endpoint, timeout_s=60) as bus, bus.map("lean") as lean:
        lean.insert(walked(), settle=True)
        before, sure = lean.estimate["x5"], lean.uncertainty.joint(["x3", "x5"])
        told = json.loads(shown(capsys, endpoint, "change", "marginalize", "lean", "x1", "x2", "--json"))
        assert (told["removed_variables"], told["added_factors"], told["removed_factors"]) == (2, 1, 4)
        np.testing.assert_allclose(lean.estimate["x5"], before, atol=1e-9)
        np.testing.assert_allclose(lean.uncertainty.joint(["x3", "x5"]), sure, rtol=1e-6)
        assert lean.graph().batch.factors[-1].kind == "linear_5_point2_se2_se2"
        said = shown(capsys, endpoint, "change", "marginalize", "lean", "x4")
        assert "added factors" in said
    shown(capsys, endpoint, "change", "marginalize", "lean", "x99", code=REFUSED)
    shown(capsys, endpoint, "change", "marginalize", "lean", code=USAGE)
