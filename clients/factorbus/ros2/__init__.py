"""Robots that speak ROS 2 over Zenoh (rmw_zenoh), on a map of ours, with no ROS installed on this side.

Odometry, poses, landmark detections, loop closures, fixes of GNSS and samples of an IMU come in; the correction from
map to odometry, the path and markers go out.  A client like any other: no compiler.  Needs the extra `ros2`.

| module | |
|---|---|
| `names` | key expressions, liveliness tokens and attachments as rmw_zenoh has them |
| `messages` | the types that are used, their hashes, CDR to objects and back |
| `node` | a ROS 2 node on a Zenoh session; the only file here that touches zenoh |
| `geometry`, `certainty` | rigid transforms and their covariances |
| `odometry`, `continuity` | odometry read, and whether it goes on from the one before |
| `track`, `front_end` | from odometry to keyframes, from messages to what is inserted; no bus and no clock |
| `observations`, `fixes` | landmarks that are seen; places by GNSS, and the frame that these are in |
| `imu_samples`, `inertial` | what an IMU measured, and the factors that it makes between keyframes |
| `graphs`, `closures` | graphs of front ends in one form, and their loop closures between keyframes |
| `mounts`, `message_parts` | where sensors are on the robot; what messages have in common, checked |
| `display` | an estimate as a path and as markers |
| `bridge` | all of it together |
| `trigger`, `services` | a type of service, and what an operator on ROS may ask of a map |
| `recording`, `unfinished_mcap` | what a robot recorded, also where it was cut off |
| `recorded_drive` | a recording as the inserts that the bridge would have sent |
"""
