"""Logs of two robots as JRL's programs write them, and of one as its documents have it."""

from pathlib import Path

import numpy as np

from factorbus.formats import GraphFile, read
from factorbus.proto.symbols import symbol

A0, A1, A2, B0, B1 = (symbol(letter, n) for letter, n in (("a", 0), ("a", 1), ("a", 2), ("b", 0), ("b", 1)))
L0, L1 = symbol("a", 1_000_000_000), symbol("a", 1_000_000_001)  # JRL's landmarks
T0 = 1403636579763555584

# As the programs write it: robots by their codes, values in arrays, scalars and bearings as objects, null for nothing.
PLANE = f"""{{
  "name": "yard", "robots": [97, 98],
  "measurements": {{
    "a": [
      {{"stamp": {T0}, "measurements": [
        {{"type": "PriorFactorPose2", "key": {A0}, "prior": {{"type": "Pose2", "x": 0.5, "y": 0, "theta": 0.25}},
          "covariance": [0.01, 0.002, 0, 0.002, 0.04, 0, 0, 0, 0.0025]}}]}},
      {{"stamp": {T0 + 20}, "measurements": [
        {{"type": "BetweenFactorPose2", "key1": {A0}, "key2": {A1},
          "measurement": {{"type": "Pose2", "x": 1, "y": 0.25, "theta": 0.5}},
          "covariance": [0.01, 0, 0, 0, 0.04, 0, 0, 0, 0.0025]}},
        {{"type": "BearingRangeFactor2D", "key1": {A1}, "key2": {L0}, "measurement": {{"type": "BearingRange",
          "bearing": {{"type": "Rot2", "theta": -0.5}}, "range": {{"type": "Scalar", "value": 4}}}},
          "covariance": [0.0001, 0, 0, 0.25]}},
        {{"type": "RangeFactor2D", "key1": {A1}, "key2": {L1}, "measurement": {{"type": "Scalar", "value": 6.5}},
          "covariance": [0.0625]}},
        {{"type": "PriorFactorPoint2", "key": {L1}, "prior": {{"type": "Point2", "x": 7, "y": 1}},
          "covariance": [1, 0.5, 0.5, 1]}}]}},
      {{"stamp": {T0 + 30}}}
    ],
    "b": [
      {{"stamp": {T0 + 10}, "measurements": [
        {{"type": "RangeFactorPose2", "key1": {A0}, "key2": {B0}, "measurement": {{"type": "Scalar", "value": 5}},
          "covariance": [0.25]}},
        {{"type": "BetweenFactorPose2", "key1": {A0}, "key2": {B0},
          "measurement": {{"type": "Pose2", "x": 3, "y": 4, "theta": 0}}, "covariance": [1, 0, 0, 0, 1, 0, 0, 0, 1]}}]}}
    ]
  }},
  "initialization": {{
    "a": [{{"type": "Pose2", "key": {A0}, "x": 0.5, "y": 0, "theta": 0.25}},
          {{"type": "Point2", "key": {L0}, "x": 4, "y": -1}}],
    "b": null
  }},
  "groundtruth": {{
    "a": [{{"type": "Pose2", "key": {A0}, "x": 0.5, "y": 0.0625, "theta": 0.25}},
          {{"type": "Point2", "key": {L0}, "x": 4, "y": -1.5}}],
    "b": [{{"type": "Pose2", "key": {B0}, "x": 3, "y": 4, "theta": 0.125}}]
  }},
  "potential_outlier_factors": {{"a": [[1, 1], [1, 2]], "b": [[0, 1]]}},
  "outlier_factors": {{"a": [[1, 2]], "b": []}}
}}"""

COVARIANCE6 = np.diag([0.0004, 0.0009, 0.0016, 0.01, 0.04, 0.09]) + np.eye(6)[::-1] * 1e-4
# As the documents have it: letters, values by their keys, plain numbers, one list of outliers where there is one robot.
SPACE = f"""{{
  "name": "hall", "robots": ["a"],
  "measurements": {{"a": [{{"stamp": 0, "measurements": [
    {{"type": "PriorFactorPose3", "key": {A0}, "prior": {{"type": "Pose3", "translation": [1, 2, 3],
      "rotation": [0.8, 0, 0, 0.6]}}, "covariance": {COVARIANCE6.ravel().tolist()}}},
    {{"type": "BetweenFactorPose3", "key1": {A0}, "key2": {A1}, "measurement": {{"type": "Pose3",
      "translation": [1, 0, 0.5], "rotation": [0.5, 0.5, -0.5, 0.5]}}, "covariance": {COVARIANCE6.ravel().tolist()}}},
    {{"type": "RangeFactorPose3", "key1": {A0}, "key2": {A1}, "measurement": 1.25, "covariance": [0.25]}},
    {{"type": "RangeFactor3D", "key1": {A0}, "key2": {L0}, "measurement": 2.5, "covariance": [0.25]}},
    {{"type": "PriorFactorPoint3", "key": {L0}, "prior": {{"type": "Point3", "x": 1, "y": 2, "z": 5.5}},
      "covariance": [1, 0, 0, 0, 1, 0, 0, 0, 1]}}]}}]}},
  "initialization": {{"a": {{
    "{A0}": {{"type": "Pose3", "translation": [1, 2, 3], "rotation": [0.8, 0, 0, 0.6]}},
    "{L0}": {{"type": "Point3", "x": 1, "y": 2, "z": 5.5}}}}}},
  "potential_outlier_factors": [[0, 2]]
}}"""


def read_text(folder: Path, text: str, name: str = "a.jrl", strict: bool = False) -> GraphFile:
    (folder / name).write_text(text)
    return read(folder / name, strict=strict)
