"""Which topics of a recording are read: those that were named, the others by their types, and what is said of that."""

from collections.abc import Sequence
from dataclasses import replace

from factorbus.ros2.messages import (
    DETECTIONS,
    FIX,
    FORMER_NAMES,
    IMU,
    LANDMARK_LIST,
    LINK,
    MAP_GRAPH,
    ODOMETRY,
    POSE,
    POSE_GRAPH,
    TAGS,
    TRANSFORMS,
)  # fmt: skip
from factorbus.ros2.problems import BadRecording
from factorbus.ros2.recording import RecordedTopic, RobotRecording
from factorbus.ros2.settings import STATIC, Settings

_SHOWN = 8  # topics in a message
# What is read of all topics of its type: (in the settings, the type, in words, the option).
_ALL_OF_TYPE = (
    ("landmarks", DETECTIONS, "landmarks", "--landmarks"),
    ("landmark_lists", LANDMARK_LIST, "landmarks", "--landmark-list"),
    ("tags", TAGS, "landmarks", "--tags"),
    ("pose_graphs", POSE_GRAPH, "closures", "--pose-graph"),
    ("map_graphs", MAP_GRAPH, "closures", "--map-graph"),
    ("links", LINK, "closures", "--link"),
)


def with_topics(recording: RobotRecording, settings: Settings) -> tuple[Settings, list[str]]:
    """The topics to read, those not named by their types, and what was chosen.  Raises BadRecording."""
    for name, type_name in settings.inputs().items():
        _check_named(recording, type_name, name)
    notes = []
    if not settings.odometry:
        settings, note = _with_odometry(recording, settings)
        notes.append(note)
    for with_more in (_with_all_of_a_type, _with_fixes):
        settings, more = with_more(recording, settings)
        notes += more
    if not settings.poses:
        notes += _poses_left_out(recording, settings)
    notes += _frames_left_out(recording, settings)
    if recording.unread:
        shown = ", ".join(recording.unread[:_SHOWN])
        notes.append(f"left out, as the form of their messages is not known or not one: {shown}")
    if not settings.imu:
        notes += _imu_left_out(recording, settings)
    return settings, notes


def frame_topics(recording: RobotRecording, settings: Settings) -> list[str]:
    """Those that say where sensors of this robot are."""
    names = _frames_of(settings)
    return [topic.name for topic in _of_type(recording, TRANSFORMS) if topic.name in names]


def _with_odometry(recording: RobotRecording, settings: Settings) -> tuple[Settings, str]:
    """With the odometry of the recording: /odom, else one that ends so, else the one with most messages."""
    found = _of_type(recording, ODOMETRY)
    if not found:
        wanted = f"a topic of {ODOMETRY}, which /tf or poses of another type do not stand for"
        raise BadRecording(recording.path, "no odometry", f"{wanted}; it has {_typed(recording.topics) or 'no topic'}")
    best = max(found, key=lambda topic: (topic.name == "/odom", topic.name.endswith("odom"), topic.count))
    others = f" (of {_listed(found)}; --odom decides)" if len(found) > 1 else ""
    return replace(settings, odometry=best.name), f"odometry: {best.name}{others}"


def _with_all_of_a_type(recording: RobotRecording, settings: Settings) -> tuple[Settings, list[str]]:
    """With this robot's observations and its front ends' graphs, of all types that are not named."""
    notes = []
    for name, type_name, what, option in _ALL_OF_TYPE:
        if getattr(settings, name) or name in settings.without:
            continue
        found, others = _of_this_robot(recording, settings, _of_type(recording, type_name))
        settings = replace(settings, **{name: tuple(topic.name for topic in found)})
        if found:
            notes.append(f"{what}: {_listed(found)}" + ("" if type_name == DETECTIONS else f" ({type_name})"))
        notes += _others_left_out(what, option, others)
    return settings, notes


def _with_fixes(recording: RobotRecording, settings: Settings) -> tuple[Settings, list[str]]:
    """With one receiver of GNSS on this robot."""
    if settings.fixes or "fixes" in settings.without:
        return settings, []
    notes = []
    found, others = _of_this_robot(recording, settings, _of_type(recording, FIX))
    if found:
        # What a filter publishes in the form of a fix was made of odometry, too.
        best = max(found, key=lambda topic: (topic.name.endswith("fix"), "filtered" not in topic.name, topic.count))
        chosen = f" (of {_listed(found)}; --fix decides)" if len(found) > 1 else ""
        settings = replace(settings, fixes=(best.name,))
        notes.append(f"GNSS: {best.name}{chosen}")
    return settings, notes + _others_left_out("GNSS", "--fix", others)


def _others_left_out(what: str, option: str, others: Sequence[RecordedTopic]) -> list[str]:
    if not others:
        return []
    takes = " ".join(f"{option} {topic.name}" for topic in others)
    return [f"{what} of another robot left out: {_listed(others)}; {takes} takes them"]


def _poses_left_out(recording: RobotRecording, settings: Settings) -> list[str]:
    """Raises BadRecording: the map is to begin with one."""
    mine, others = _of_this_robot(recording, settings, _of_type(recording, POSE))
    found = mine or others
    if settings.start == "pose":
        wanted = f"--pose with one of {_listed(found)}" if found else f"a topic of {POSE}, and it has none"
        raise BadRecording(recording.path, "--start pose, and no poses are read", wanted)
    if not found:
        return []
    takes = " ".join(f"--pose {topic.name}" for topic in found)
    return [f"poses left out: {_listed(found)}; {takes} takes them, and --start pose begins with the first"]


def _frames_left_out(recording: RobotRecording, settings: Settings) -> list[str]:
    names = _frames_of(settings)
    found = [topic for topic in _of_type(recording, TRANSFORMS) if topic.name.endswith(STATIC)]
    others = [topic for topic in found if topic.name not in names]
    if not others:
        return []
    return [f"frames of sensors left out: {_listed(others)}; those of {' and '.join(names)} are read"]


def _imu_left_out(recording: RobotRecording, settings: Settings) -> list[str]:
    mine, others = _of_this_robot(recording, settings, _of_type(recording, IMU))
    if not mine:
        return [f"IMU of another robot left out: {_listed(others)}"] if others else []
    takes = f"--space --imu {mine[0].name} takes its raw samples"
    return [f"IMU left out: {_listed(mine)}; {takes}, where odometry was not made of them already"]


def _check_named(recording: RobotRecording, type_name: str, name: str) -> None:
    """Raises BadRecording: a topic that was named is not there, or has messages of another type."""
    topics = {topic.name: topic for topic in recording.topics}
    if name not in topics:
        instead = "" if type_name in (ODOMETRY, IMU) else ", or none"
        raise BadRecording(recording.path, f"no topic {name}", f"one of {_listed(recording.topics)}{instead}")
    if _type_of(topics[name]) != type_name:
        there = _listed(_of_type(recording, type_name)) or "none"
        wanted = f"a topic of {type_name} (there is {there})"
        raise BadRecording(recording.path, f"{name} is of {topics[name].type_name}", wanted)


def _of_this_robot(
    recording: RobotRecording, settings: Settings, found: Sequence[RecordedTopic]
) -> tuple[list[RecordedTopic], list[RecordedTopic]]:
    """(topics of the robot whose odometry is read, those of others).

    Robots are told apart by the first part of names, where each has an odometry that is called the same behind it.
    """
    mine, name = _namespaced(settings.odometry)
    robots = {_namespaced(topic.name)[0] for topic in _of_type(recording, ODOMETRY) if topic.name.endswith(f"/{name}")}
    others = robots - {mine} if mine else set[str]()
    theirs = [topic for topic in found if _namespaced(topic.name)[0] in others]
    return [topic for topic in found if topic not in theirs], theirs


def _namespaced(topic: str) -> tuple[str, str]:
    """("/robot1", "odom") of /robot1/odom; ("", "odom") of /odom."""
    first, _, rest = topic.removeprefix("/").partition("/")
    return (f"/{first}", rest) if rest else ("", first)


def _frames_of(settings: Settings) -> list[str]:
    """Topics of where sensors are: of all robots, and of this one."""
    return list(dict.fromkeys((STATIC, _namespaced(settings.odometry)[0] + STATIC)))


def _of_type(recording: RobotRecording, type_name: str) -> list[RecordedTopic]:
    return [topic for topic in recording.topics if _type_of(topic) == type_name]


def _type_of(topic: RecordedTopic) -> str:
    """Its type by the present name."""
    return FORMER_NAMES.get(topic.type_name, topic.type_name)


def _listed(topics: Sequence[RecordedTopic]) -> str:
    more = f" and {len(topics) - _SHOWN} more" if len(topics) > _SHOWN else ""
    return ", ".join(topic.name for topic in topics[:_SHOWN]) + more


def _typed(topics: Sequence[RecordedTopic]) -> str:
    more = f" and {len(topics) - _SHOWN} more" if len(topics) > _SHOWN else ""
    return ", ".join(f"{topic.name} ({topic.type_name})" for topic in topics[:_SHOWN]) + more
