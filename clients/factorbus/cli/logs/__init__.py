"""Logs of an IMU with GNSS, odometry or poses, of which `replay` makes a map: EuRoC, KITTI raw, GTSAM's KITTI."""
