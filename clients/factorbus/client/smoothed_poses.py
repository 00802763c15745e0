"""Poses of a mirror, raw and with their corrections blended over a time."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from factorbus.client.arguments import checked_duration
from factorbus.client.blending import PoseBlend
from factorbus.client.key_numbers import Key, key_number
from factorbus.client.mirror import Mirror
from factorbus.proto.arrays import F64
from factorbus.proto.messages import Delta
from factorbus.proto.problems import BadOption, NotHeld

_KINDS = ("se2", "se3")
# Poses whose corrections are followed, those asked for last: a robot asks for its newest, and goes on to the next.
_FOLLOWED = 1024


class BlendedPose(NamedTuple):
    """A pose (3,) or (7,) as it is to be used now.  raw: as the map has it.  left_s: until both are the same."""

    pose: F64
    raw: F64
    left_s: float


class SmoothedPoses:
    """Of one mirror.  Any thread may ask.

    A pose is followed from the first time that it is asked for with `smooth_s`: what came before is no correction.
    Times of arrival count, so how often one asks does not change what is given.
    """

    def __init__(self, mirror: Mirror, clock: Callable[[], float] = time.monotonic) -> None:
        self._mirror, self._clock = mirror, clock
        self._lock = threading.Lock()  # held while the mirror is read: nobody corrects by an older value than another
        self._blends: OrderedDict[tuple[int, float], PoseBlend] = OrderedDict()
        self._epoch = 0
        mirror.on_delta(self._on_delta)

    def pose(self, key: Key, smooth_s: float) -> BlendedPose:
        """Of a variable, now.  Raises NotHeld, a KeyError; BadOption: of a time, or of what is no pose."""
        smooth_s = checked_duration("smooth_s", smooth_s)
        with self._lock:
            self._begin_again_for_another_map()
            raw = self._raw(key)
            if not smooth_s:
                return BlendedPose(raw, raw.copy(), 0.0)
            return self._blended((key_number(key), smooth_s), raw)

    def _blended(self, of: tuple[int, float], raw: F64) -> BlendedPose:
        now_s, blend = self._clock(), self._blends.get(of)
        if blend is None or blend.raw.size != raw.size:
            blend = self._blends[of] = PoseBlend(raw, of[1])
        self._blends.move_to_end(of)
        if len(self._blends) > _FOLLOWED:
            self._blends.popitem(last=False)
        blend.correct(raw, now_s)  # where the value is here and its delta has not been told yet
        return BlendedPose(blend.at(now_s), raw, blend.left_s(now_s))

    def _on_delta(self, delta: Delta) -> None:
        """On the mirror's thread."""
        with self._lock:
            self._begin_again_for_another_map()
            now_s = self._clock()
            for of in self._touched(delta):
                blend = self._blends[of]
                try:
                    raw = self._raw(of[0])
                except (NotHeld, BadOption):
                    del self._blends[of]  # it has gone: one that comes under its key is another
                    continue
                if blend.raw.size == raw.size:
                    blend.correct(raw, now_s)

    def _touched(self, delta: Delta) -> Iterable[tuple[int, float]]:
        followed = list(self._blends)
        if delta.previous == 0 or not followed:  # the whole estimate
            return followed
        numbers = np.array([number for number, _ in followed], np.int64)
        touched = np.zeros(len(followed), bool)
        for group in delta.variables:
            touched |= np.isin(numbers, group.keys)
        return [followed[i] for i in np.flatnonzero(touched)]

    def _raw(self, key: Key) -> F64:
        kind, value = self._mirror.find(key)
        if kind not in _KINDS:
            raise BadOption("key", f"{key} of kind {kind}", "a pose, se2 or se3; `estimate` has all other values")
        return value

    def _begin_again_for_another_map(self) -> None:
        if self._epoch != self._mirror.epoch:
            self._epoch = self._mirror.epoch
            self._blends.clear()
