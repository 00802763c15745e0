"""What a robot drafted in mixed order: ids of the answer, verdicts and gains are those of its calls."""

import asyncio

import pytest

from factorbus.client import Changes, Draft, aio, connect

SIGMAS = (0.1, 0.1, 0.02)
RIGHT, WRONG = (2.0, 0.0, 0.0), (2.0, 9.0, 0.0)


def candidates() -> Draft:
    """A wrong one first, in losses and kinds that a message has apart."""
    return (
        Draft()
        .between_se2("x0", "x2", WRONG, sigmas=SIGMAS, loss="huber")
        .landmark_se2("x2", "l0", (-1.0, 7.0), sigmas=(0.1, 0.1))
        .between_se2("x0", "x2", RIGHT, sigmas=SIGMAS)
        .landmark_se2("x2", "l0", (-1.0, 1.0), sigmas=(0.1, 0.1))
        .between_se2("x0", "x2", RIGHT, sigmas=(1.0, 1.0, 0.2), loss="huber")
    )


def test_ids_verdicts_and_gains_are_those_of_the_calls(endpoint: str) -> None:
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("mixed-order") as mixed:
        base = Draft().se2("x0", (0, 0, 0), fixed=True).se2("x1").se2("x2").point2("l0")
        base.between_se2("x0", "x1", (1, 0, 0), sigmas=SIGMAS).landmark_se2("x1", "l0", (0, 1), sigmas=(0.1, 0.1))
        base.between_se2("x1", "x2", (1, 0, 0), sigmas=SIGMAS)
        mixed.insert(base)
        gated = mixed.uncertainty.gate(candidates())
        assert gated.plausible.tolist() == [False, False, True, True, True]
        gains = mixed.uncertainty.gain(candidates()).gain
        assert gains[4] < gains[2]  # of a tenth of the certainty

        async def asked() -> tuple[list[bool], list[float]]:
            async with aio.connect(endpoint, client="asking", timeout_s=60) as hall, hall.map("mixed-order") as joined:
                verdicts = await joined.uncertainty.gate(candidates())
                return verdicts.plausible.tolist(), (await joined.uncertainty.gain(candidates())).gain.tolist()

        assert asyncio.run(asked()) == (gated.plausible.tolist(), gains.tolist())

        accepted = mixed.insert(candidates())
        assert sorted(accepted.factors) == list(range(accepted.first_factor, accepted.first_factor + 5))
        mixed.change(Changes().remove_factors([accepted.factors[0], accepted.factors[1]]), settle=True)
        assert mixed.chi2().chi2 == pytest.approx(0.0, abs=1e-9)
        assert mixed.graph().batch.factor_count == 3 + 3
