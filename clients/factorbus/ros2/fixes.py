"""Fixes of GNSS, sensor_msgs/NavSatFix, as positions of an antenna in a frame that the map's pose in is found out.

The first good fix is the origin: places are metres east, north and up of it.  Fixes are collected until the robot has
moved ten times as far as they are uncertain.  Then a turn about the vertical and a shift, in closed form, bring the
places by odometry onto the fixes, weights w = 1/σ²,

    θ = atan2(Σ w aᵢ × bᵢ, Σ w aᵢ · bᵢ),   t = b̄ − R(θ) ā,   aᵢ, bᵢ: by odometry and by GNSS, from their means,

and the variable f, T_enu_map, goes into the map with all of them; each later fix as it comes.  A fix belongs to the
last keyframe before it: where the antenna was from there, by odometry, is its lever arm.  No bus and no clock.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorbus.client.draft import Draft
from factorbus.client.geodetic import enu
from factorbus.proto.arrays import F64
from factorbus.proto.symbols import format_symbol, symbol
from factorbus.ros2.certainty import floored, information
from factorbus.ros2.geometry import Transform, from_plane
from factorbus.ros2.message_parts import Notes
from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.settings import FRAME_LETTER, Settings
from factorbus.ros2.space import SPACES
from factorbus.wording import counted

_FAR, _LEAST_M, _FEWEST = 10.0, 1.0, 4  # times σ, metres, fixes: from then on the frame is found out
_COLLECTED = 4096  # fixes that may wait for that
_EACH_KEYFRAME = 10  # fixes: a robot that stands still does not fill the map
_HIGHEST_M, _FARTHEST_M = 1e5, 1e5  # heights; how far from the origin
_TILT_RAD, _ANYWHERE_M, _ANY_RAD = 0.1, 1e5, math.pi
_UP = 2


@dataclass(frozen=True, slots=True)
class Fix:
    """latitude, longitude (degrees) and height (metres) of an antenna; covariance (3, 3): east, north, up, m²."""

    place: F64
    covariance: F64


@dataclass(frozen=True, slots=True)
class Antenna:
    """Where an antenna was at a fix: in the frame of its keyframe, and in the map by odometry alone.

    variance: what odometry since the keyframe adds in any direction, m².  unplaced: says that nothing tells where its
    frame is on the robot, in whose middle it is then; empty: its place is known.
    """

    key: int
    lever: F64
    in_map: F64
    variance: float
    unplaced: str = ""


@dataclass(frozen=True, slots=True)
class _Placed:
    """place: computes the antenna by what is known now of where its frame is on the robot."""

    topic: str
    fix: Fix
    antenna: Antenna
    place: Callable[[], Antenna]


def read_fix(topic: str, message: Any, sigma_m: float, axes: tuple[int, ...], notes: Notes) -> Fix | None:
    """None: the receiver says that it has no fix.  sigma_m: of one that does not say how good it is.

    axes: those of east, north and up that count.  Raises BadRosMessage.
    """
    place = np.array([message.latitude, message.longitude, message.altitude], np.float64)
    if message.status.status < 0:
        notes.remark(topic, "no fix (status -1): left out")
        return None
    if place[0] == 0.0 and place[1] == 0.0:
        notes.remark(topic, "latitude 0 and longitude 0, as receivers without a fix say: left out")
        return None
    if not (abs(place[0]) <= 90.0 and abs(place[1]) <= 360.0):
        seen = f"latitude {place[0]:g}, longitude {place[1]:g}"
        raise BadRosMessage(topic, seen, "degrees: -90 to 90, and -180 to 180")
    if not math.isnan(place[_UP]) and not abs(place[_UP]) <= _HIGHEST_M:
        raise BadRosMessage(topic, f"an altitude of {place[_UP]:g} m", f"at most {_HIGHEST_M:g} m, or NaN")
    known = tuple(axis for axis in axes if axis != _UP or not math.isnan(place[_UP]))
    covariance = _covariance(topic, message, sigma_m, known, notes)
    if math.isnan(place[_UP]):
        if _UP in axes:
            notes.remark(topic, "no altitude (NaN): taken as not known")
        place[_UP], covariance[_UP, _UP] = 0.0, _ANYWHERE_M**2
    return Fix(place, covariance)


def _covariance(topic: str, message: Any, sigma_m: float, axes: tuple[int, ...], notes: Notes) -> F64:
    """(3, 3) of east, north and up, by its type.  Raises BadRosMessage."""
    kind = int(message.position_covariance_type)
    if kind == 0:
        text = f"covariance of unknown type: taken as a standard deviation of {sigma_m:g} m (--fix-sigma)"
        notes.remark(topic, text)
        return np.diag([sigma_m**2] * 3)
    if kind not in (1, 2, 3):
        raise BadRosMessage(topic, f"a covariance of type {kind}", "0 (unknown) to 3 (known)")
    numbers = np.asarray(message.position_covariance, np.float64).reshape(3, 3)
    if kind != 3:  # of those only the diagonal means something
        numbers = np.diag(numbers.diagonal())
    whole = np.zeros((6, 6))
    whole[:3, :3] = numbers
    return notes.checked(topic, "position", whole.ravel(), axes).whole[:3, :3].copy()


class GnssFixes:
    """All fixes of a robot, and whether their frame is in the map.  index: of the key of that frame."""

    def __init__(self, settings: Settings, index: int, notes: Notes) -> None:
        self._settings, self._space, self._notes = settings, SPACES[settings.space], notes
        self.forget(index)

    def forget(self, index: int) -> None:
        """As new, for a map that is another one."""
        self._frame = symbol(FRAME_LETTER, index)
        self._origin: F64 | None = None
        self._collected: deque[_Placed] = deque(maxlen=_COLLECTED)
        self._counts: Counter[tuple[str, int]] = Counter()
        self._has_frame = False
        self._last: dict[str, bytes] = {}

    def check_new(self, topic: str, message: Any) -> None:
        """Raises BadRosMessage: it is the last one of its topic again, which would count twice."""
        stamp = message.header.stamp
        numbers = message.latitude, message.longitude, message.altitude, *message.position_covariance
        kinds = message.status.status, message.position_covariance_type
        one = np.array([stamp.sec, stamp.nanosec, *kinds, *numbers], np.float64).tobytes()
        if self._last.get(topic) == one:
            raise BadRosMessage(topic, f"a fix of {stamp.sec}.{stamp.nanosec:09d} s twice", "each fix once")
        self._last[topic] = one

    def rewind(self, present: Callable[[int], bool]) -> None:
        """An insert was refused: what is not in the map is not there."""
        self._has_frame = self._has_frame and present(self._frame)
        kept = [each for each in self._collected if present(each.antenna.key)]
        self._collected = deque(kept, _COLLECTED)

    def use(self, topic: str, fix: Fix, place: Callable[[], Antenna], draft: Draft) -> None:
        """A fix; place: where the antenna was by odometry.  Once the frame is known it goes into the draft.

        Raises BadRosMessage.
        """
        antenna = place()
        self._counts = Counter({name: count for name, count in self._counts.items() if name[1] >= antenna.key})
        self._counts[topic, antenna.key] += 1
        if self._counts[topic, antenna.key] > _EACH_KEYFRAME:
            self._notes.remark(topic, f"more than {_EACH_KEYFRAME} fixes at one keyframe: left out")
            return
        placed = _Placed(topic, fix, antenna, place)
        if self._origin is None or self._is_elsewhere(placed):
            self._origin = fix.place
            self._collected.clear()
            where = f"latitude {fix.place[0]:.7f}, longitude {fix.place[1]:.7f}, altitude {fix.place[2]:.2f} m"
            self._notes.remark(topic, f"the origin of GNSS is {where}")
        if (off := float(np.linalg.norm(self._enu(placed)))) > _FARTHEST_M:
            raise BadRosMessage(topic, f"a place {off:.3g} m from the first fix", f"at most {_FARTHEST_M:g} m")
        if self._has_frame:
            self._insert(placed, draft)
            return
        self._collected.append(placed)
        if self._is_far():
            self._insert_frame(topic, draft)

    def open_ends(self) -> Iterator[str]:
        """What is still collected, for people, where a recording ends."""
        if self._collected and not self._has_frame:
            moved, wanted = self._moved(), self._wanted()
            yield (
                f"{counted(len(self._collected), 'fix', 'fixes')} left out: the robot has moved {moved:.3g} m, "
                f"and {wanted:.3g} m and {_FEWEST} fixes are wanted to see where north is"
            )

    def _is_elsewhere(self, placed: _Placed) -> bool:
        """The first fix was a wild one: few have come, and this one is out of reach of it."""
        few = not self._has_frame and len(self._collected) < _FEWEST
        return few and float(np.linalg.norm(self._enu(placed))) > _FARTHEST_M

    def _enu(self, placed: _Placed) -> F64:
        origin = placed.fix.place if self._origin is None else self._origin
        return enu(placed.fix.place, origin)

    def _information(self, placed: _Placed) -> F64:
        axes = list(self._space.point_axes)
        covariance = placed.fix.covariance + placed.antenna.variance * np.eye(3)
        floor = np.full(len(axes), self._settings.floors.fix_m)
        return information(floored(covariance[np.ix_(axes, axes)], floor))

    def _insert(self, placed: _Placed, draft: Draft) -> None:
        axes = list(self._space.point_axes)
        antenna, weight = placed.antenna, self._information(placed)
        if antenna.unplaced:
            self._notes.remark(placed.topic, antenna.unplaced)
        measured, lever = self._enu(placed)[axes], antenna.lever[axes]
        add = draft.position_se2 if self._space.flat else draft.position_se3
        add(antenna.key, measured, lever=lever, frame=self._frame, information=weight)

    def _insert_frame(self, topic: str, draft: Draft) -> None:
        # A static transform may come after the first fixes, on a machine that is busy.
        known = (replace(each, antenna=each.place()) if each.antenna.unplaced else each for each in self._collected)
        self._collected = deque(known, _COLLECTED)
        T, rms = self._aligned()
        row = self._space.row(T)
        draft.variable(self._space.pose, self._frame, row)
        if not self._space.flat:  # a straight drive does not tell how it leans; the map's z axis is about up
            sigmas = [_ANYWHERE_M] * 3 + [_TILT_RAD] * 2 + [_ANY_RAD]
            draft.prior_se3(self._frame, row, sigmas=sigmas)
        for placed in self._collected:
            self._insert(placed, draft)
        name, found = format_symbol(self._frame), counted(len(self._collected), "fix", "fixes")
        text = f"GNSS's frame {name} by {found} over {self._moved():.3g} m: the map is turned by {T.yaw():.3f} rad"
        self._notes.remark(topic, f"{text}, and {rms:.2g} m (rms) off")
        self._collected.clear()
        self._has_frame = True

    def _is_far(self) -> bool:
        return len(self._collected) >= _FEWEST and self._moved() > self._wanted()

    def _moved(self) -> float:
        """How far, over the ground, the places are from the first one by odometry, metres."""
        places = np.array([each.antenna.in_map[:2] for each in self._collected])
        return float(np.linalg.norm(places - places[0], axis=1).max())

    def _wanted(self) -> float:
        return max(_LEAST_M, _FAR * math.sqrt(float(np.median([_variance(each) for each in self._collected]))))

    def _aligned(self) -> tuple[Transform, float]:
        """(T_enu_map by odometry alone, how far the fixes are off then, metres rms over the ground)."""
        here = np.array([each.antenna.in_map for each in self._collected])
        there = np.array([self._enu(each) for each in self._collected])
        w = 1.0 / np.array([max(_variance(each), self._settings.floors.fix_m**2) for each in self._collected])
        up = 1.0 / np.array([max(each.fix.covariance[2, 2], 1e-4) for each in self._collected])
        here_mean, there_mean = (w @ here) / w.sum(), (w @ there) / w.sum()
        a, b = here - here_mean, there - there_mean
        yaw = math.atan2(w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), w @ (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
        R = from_plane(0.0, 0.0, yaw).R
        t = there_mean - R @ here_mean
        t[_UP] = 0.0 if self._space.flat else up @ (there[:, _UP] - here[:, _UP]) / up.sum()
        off = there - here @ R.T - t
        return Transform(R, t), math.sqrt(float((off[:, :2] ** 2).sum(axis=1).mean()))


def _variance(placed: _Placed) -> float:
    """Over the ground, of the less certain direction, m²."""
    return float(placed.fix.covariance[[0, 1], [0, 1]].max()) + placed.antenna.variance
