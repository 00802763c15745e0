"""What cameras see, drafted: the columns on the wire; and following a map whose features become points."""

from pathlib import Path

import numpy as np
import pytest

from factorbus.client import Draft
from factorbus.client.following import Following
from factorbus.client.held_values import HeldValues
from factorbus.proto import codec
from factorbus.proto.camera import Camera
from factorbus.proto.messages import Delta, Estimate, Insert, Variables
from factorbus.proto.problems import BadInformation, BadLoss, BadShape
from factorbus.proto.symbols import symbol

VECTORS = Path(__file__).parents[2] / "proto" / "vectors"
RADTAN = Camera("radtan", (400.0, 401, 320, 240, -0.25, 0.125, 0.001, -0.002))
KEY = symbol("f", 1)


def test_a_draft_of_observations_is_the_golden_insert() -> None:
    golden = codec.decode_insert((VECTORS / "insert_observations.msgpack").read_bytes()).batch
    radial = golden.factors[2].measured[0, 3:]
    camera = Camera("radial", (radial[0] * radial[5], *radial[[5, 6, 2, 3, 7, 8]]))
    draft = Draft().se3("x1", (0, 0, 0, 0, 0, 0, 1)).se3("x2", (0.5, 0, 0, 0, 0, 0, 1)).idp("f1")
    draft.point3("p1", (0.25, 0.5, 4))
    draft.idp_first("x1", "f1", RADTAN, (330, 250), 0.25, sigma_rho=1, sigma_pixel=1, sigma_anchor=1)
    draft.idp_seen("x2", "f1", RADTAN, (280, 250), sigmas=(1, 1), loss=("huber", 1.5))
    draft.point_seen("x1", "p1", camera, (175, 150), sigmas=(1, 1), loss=("dcs", 2))
    batch = draft.batch()
    for mine, theirs in zip(batch.factors, golden.factors, strict=True):
        assert (mine.kind, mine.loss, mine.keys.tolist()) == (theirs.kind, theirs.loss, theirs.keys.tolist())
        np.testing.assert_allclose(mine.measured, theirs.measured, rtol=3e-3)
        np.testing.assert_array_equal(mine.information, theirs.information)
        assert (mine.scale is None) == (theirs.scale is None)
        assert mine.scale is None or mine.scale.tolist() == theirs.scale.tolist()
    assert codec.decode_insert(codec.encode_insert(Insert(1, batch, convert_below=0.1))).convert_below == 0.1


@pytest.mark.parametrize("loss", [("welsch", 1.0), ("huber", 0.0), ("huber", float("nan"))])
def test_losses_that_are_none_are_refused(loss: tuple[str, float]) -> None:
    with pytest.raises(BadLoss):
        Draft().idp_seen("x0", "f0", RADTAN, (1, 2), sigmas=(1, 1), loss=loss)


def test_a_pixel_has_two_numbers() -> None:
    with pytest.raises(BadShape):
        Draft().point_seen("x0", "p0", RADTAN, (1, 2, 3), sigmas=(1, 1))


def test_a_delta_of_everything_lets_go_of_what_there_was() -> None:
    feature = Variables("idp", np.array([KEY]), np.zeros((1, 6)))
    point = Variables("point3", np.array([KEY]), np.array([[1.0, 2, 3]]))
    following = Following()
    start = Estimate(7, 3, (feature,))
    following.estimate(start, HeldValues(start.variables))
    whole = Delta(7, 4, 0, (point,))
    assert following.delta(whole) == [whole]
    assert (following.live, following.revision, following.values.count()) == (True, 4, 1)
    assert following.values.columns_of("idp") is None
    np.testing.assert_array_equal(following.values.find(KEY)[1], [1, 2, 3])
    assert following.delta(whole) == [], "it has been seen"
    after = Delta(7, 5, 4, (point,))
    assert following.delta(after) == [after]


@pytest.mark.parametrize(
    ("certainty", "words"),
    [
        ({}, "no sigma_rho"),
        ({"sigma_pixel": 1.0}, "no sigma_rho"),
        ({"sigma_rho": 1.0, "sigma_pixels": 1.0}, "no keyword 'sigma_pixels'.*sigma_pixel"),
    ],
)
def test_the_certainty_of_a_first_observation_is_checked_by_name(certainty: dict[str, float], words: str) -> None:
    with pytest.raises(BadInformation, match=words):
        Draft().idp_first("x1", "f1", RADTAN, (330, 250), 0.25, **certainty)
