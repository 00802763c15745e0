"""A robot that speaks only ROS 2 over Zenoh: drives a square by odometry that drifts, past tags that it knows again.

robot.py ENDPOINT DOMAIN      what it was told in return, as one line of JSON after `done`
"""

import json
import math
import sys

import ros
import words

SIDE_M, STEPS, STEP_S = 5.0, 10, 1.0
TAGS = {"3": (2.5, 1.0), "17": (6.0, 2.5), "42": (2.5, 6.0), "dock": (-1.0, 2.5), "5": (2.5, 2.5)}
# Where its camera is, and how far off its odometry: 3 % too long, and turning left.
CAMERA = (0.3, 0.0, math.pi / 2)
SCALE, CURVATURE = 1.03, 0.02
REACH_M = 5.0
KEYFRAMES = 1 + 4 * (STEPS + 1)
TOKENS = 1 + 4 + 4 + 6  # its node, publishers, subscriptions and services


def main() -> None:
    endpoint, domain = sys.argv[1], int(sys.argv[2])
    with ros.session(endpoint) as bus:
        node = ros.RosNode(bus, domain)
        for topic, cls in {
            "/tf": words.TFMessage, "/factorbus/path": words.Path, "/factorbus/markers": words.MarkerArray
        }.items():  # fmt: skip
            node.subscribe(topic, cls)
        print("ready", flush=True)
        sys.stdin.readline()
        node.wait_for_endpoints(8)
        print("done", json.dumps(drive(node) | {"tokens": node.tokens(TOKENS)}), flush=True)


def drive(node: ros.RosNode) -> dict[str, object]:
    true, told, ns = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 10**18
    transform, attached = say(node, ns, true, told)
    numbers = [attached[0]]
    for _ in range(4):
        for leg in [(SIDE_M / STEPS, 0.0, 0.0)] * STEPS + [(0.0, 0.0, math.pi / 2)]:
            true = ros.compose(true, leg)
            told = ros.compose(told, (SCALE * leg[0], 0.0, leg[2] + CURVATURE * leg[0]))
            ns += int(STEP_S * 1e9)
            transform, attached = say(node, ns, true, told)
            numbers.append(attached[0])
    last = transform.transforms[-1]
    # What is drawn may be of the step before, at first.
    while len((path := node.wait_for("/factorbus/path")[0]).poses) < KEYFRAMES:
        pass
    landmarks, _ = node.wait_for("/factorbus/markers")[0].markers
    return {
        "true": true,
        "told": told,
        "corrected": ros.compose(ros.plane(last.transform), told),
        "frames": [last.header.frame_id, last.child_frame_id],
        "ahead_s": (last.header.stamp.sec * 10**9 + last.header.stamp.nanosec - ns) / 1e9,
        "numbers": numbers,
        "gid": attached[2].hex(),
        "path": [path.header.frame_id, len(path.poses)],
        "landmarks": sorted([round(p.x, 3), round(p.y, 3), round(p.z, 3)] for p in landmarks.points),
    }


def say(
    node: ros.RosNode, ns: int, true: tuple[float, float, float], told: tuple[float, float, float]
) -> tuple[words.TFMessage, tuple[int, int, bytes]]:
    """Tags first, then the odometry of the same time; waits for the transform that comes of it."""
    camera, seen = ros.compose(true, CAMERA), []
    for name, place in TAGS.items():
        x, y, _ = ros.compose(ros.inverse(camera), (*place, 0.0))
        if math.hypot(x, y) < REACH_M:
            seen.append((name, (x, y, 0.0), 0.02))
    node.publish("/detections", ros.detections(ns, "camera", seen))
    node.publish("/odom", ros.odometry(ns, told, [4e-4, 4e-4, 0, 0, 0, 4e-4]))
    while True:
        transform, attached = node.wait_for("/tf")
        last = transform.transforms[-1].header.stamp
        if last.sec * 10**9 + last.nanosec >= ns:
            return transform, attached


if __name__ == "__main__":
    main()
