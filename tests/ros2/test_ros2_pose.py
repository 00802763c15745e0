"""The pose with its covariance comes after every step, whenever anything is drawn."""

import signal
from collections.abc import Callable

import numpy as np
import ros
import words
from processes import Process

from factorbus.client import connect

DOMAIN = 31
VARIANCE = 4e-4


def test_every_keyframe_has_its_pose_at_once(endpoint: str, spawn: Callable[..., Process]) -> None:
    """The first path comes after a minute: no test waits for that."""
    with connect(endpoint, client="maker", timeout_s=60) as bus, bus.map("posed", mirror=False):
        pass
    options = ("--connect", endpoint, "--domain", str(DOMAIN), "--display", "60")
    bridge = spawn("-m", "factorbus.cli", "ros2", "posed", *options)
    bridge.ready()
    with ros.session(endpoint) as bus, connect(endpoint, client="looker", timeout_s=60) as ours:
        robot = ros.RosNode(bus, DOMAIN)
        robot.subscribe("/factorbus/pose", words.PoseWithCovarianceStamped)
        robot.wait_for_endpoints(8)
        for n in range(6):
            ns = 10**18 + n * 10**9
            robot.publish("/odom", ros.odometry(ns, (float(n), 0.0, 0.0), [VARIANCE] * 6))
            while (said := robot.wait_for("/factorbus/pose")[0]).header.stamp != ros.stamp(ns):
                pass
            assert said.header.frame_id == "map"
            assert abs(said.pose.pose.position.x - n) < 1e-6
            with ours.map("posed", create=False) as looked:
                certain = looked.uncertainty.covariance(f"x{n}")[f"x{n}"]
            told = np.array(said.pose.covariance).reshape(6, 6)[np.ix_([0, 1, 5], [0, 1, 5])]
            np.testing.assert_allclose(told, certain, atol=1e-9)  # headings are 0: the axes are the map's
            assert n == 0 or told[0, 0] > 0
    bridge.signal(signal.SIGINT)
    assert bridge.wait() == 0
