"""Cameras in a map over the bus: features, points that they become, losses, refusals, and a mirror that follows."""

import numpy as np
import pytest
from bench.idp_map import Far, FrontEnd, judged
from naive.random_cameras import CAMERAS

from factorbus.client import Draft, connect
from factorbus.proto.problems import Refused
from factorbus.simulate import monocular


def test_features_become_points_while_a_mirror_follows(endpoint: str) -> None:
    with (
        connect(endpoint, client="camera", timeout_s=60) as bus,
        bus.map("observations") as joined,
        connect(endpoint, client="viewer", timeout_s=60) as other,
        other.map("observations") as watched,
    ):
        far = Far(joined)
        front = FrontEnd(monocular(40, 4, points=80), far, convert_below=0.1, every=10)
        front.run()
        graph = joined.graph().batch
        counts = {group.kind: len(group.keys) for group in graph.variables if not group.fixed}
        assert counts["se3"] == 39
        assert counts["point3"] > 0
        watched.estimate.wait_for(joined.estimate.revision)
        for mirror in (joined.estimate, watched.estimate):
            seen = {kind: (keys.tolist(), values) for kind, (keys, values) in mirror.snapshot().columns.items()}
            for group in graph.variables:
                if group.fixed:
                    continue
                order = np.argsort(group.keys)
                keys, values = seen[group.kind]
                mine = np.isin(keys, group.keys)
                assert np.array(keys)[mine].tolist() == group.keys[order].tolist()
                np.testing.assert_array_equal(values[mine], group.values[order])
            assert set(seen.get("idp", ([], ()))[0]).isdisjoint(seen["point3"][0])
        found = judged(front, graph)
        assert found["inverse_depth"]["within"] > 0.9
        assert found["error_m"]["rms"] < 0.05


def test_what_no_camera_can_see_is_refused_and_losses_travel(endpoint: str) -> None:
    camera = CAMERAS["radtan"]
    with connect(endpoint, client="camera2", timeout_s=60) as bus, bus.map("losses") as joined:
        draft = Draft().se3("x0", (0, 0, 0, 0, 0, 0, 1), fixed=True).point3("p0", (0, 0, 4))
        draft.prior_point3("p0", (0, 0, 4), sigmas=(1, 1, 1))
        draft.point_seen("x0", "p0", camera, (380, 260), sigmas=(1, 1), loss=("huber", 1.5))
        accepted = joined.insert(draft)
        assert accepted.report["inactive"] == 0
        [group] = [group for group in joined.graph().batch.factors if group.loss]
        assert (group.kind, group.loss, group.scale.tolist()) == ("point_seen", "huber", [1.5])
        behind = Draft().point3("p1", (0, 0, -4)).prior_point3("p1", (0, 0, -4), sigmas=(1, 1, 1))
        behind.point_seen("x0", "p1", camera, (380, 260), sigmas=(1, 1))
        with pytest.raises(Refused, match="behind the camera") as refused:
            joined.insert(behind)
        assert refused.value.code == "bad_observation"
        assert joined.estimate.revision == accepted.revision
