"""The bench `lifelong`, in small: a service that is killed, a map that keeps some poses and tests its closures."""

from pathlib import Path

import numpy as np
from bench import lifelong


def test_nothing_is_lost_and_the_journal_gives_the_same_bits(tmp_path: Path) -> None:
    result = lifelong.run(360, 3, 0.3, 5, tmp_path)
    assert [row["steps"] for row in result["rows"]] == [120, 240, 360]
    assert result["lost"] == 0
    assert result["verified"]["differs_from"] is result["verified"]["code"] is None
    assert result["verified"]["records"] > 360
    assert result["rows"][-1]["variables"] < 300
    assert result["rows"][-1]["closures"] > 20
    assert max(row["error_m"] for row in result["rows"]) < 0.5


def test_the_round_is_closed_and_what_a_robot_sees_leads_round_it() -> None:
    robot = lifelong.Robot(0.0, 1)
    x, y, theta = 0.0, 0.0, 0.0
    for n in range(lifelong.ROUND):
        dx, dy, turn = robot.seen(n, n + 1, (0.0, 0.0, 0.0))
        x, y = x + np.cos(theta) * dx - np.sin(theta) * dy, y + np.sin(theta) * dx + np.cos(theta) * dy
        theta += turn
    assert np.hypot(x, y) < 1e-9
    assert np.isclose(theta, 2 * np.pi)
