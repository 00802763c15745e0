"""The entities of a Foxglove scene: trajectory, landmarks, loop closures, and what the last step changed."""

from typing import Any

import numpy as np
from foxglove import messages as fox

from factorbus.proto.arrays import F64
from factorbus.viz import style
from factorbus.viz.closures import closures_of, colours_of
from factorbus.viz.geometry import Track, points_of, track_of
from factorbus.viz.map_follower import Look

_LETTER_BITS = 56
_PIXELS = 2.0
_LANDMARK_M = 0.3


def scene_of(look: Look, stamp: fox.Timestamp) -> fox.SceneUpdate:
    """All that is drawn of a look; an entity replaces the one of the same name before it."""
    track, points = track_of(look.variables), points_of(look.variables)
    letters = track.keys >> _LETTER_BITS
    entities = [
        _entity(f"trajectory {chr(letter) if letter else ''}".strip(), stamp, lines=[_strip(track, letters == letter)])
        for letter in np.unique(letters).tolist()
    ]
    spheres = [_sphere(place) for place in _in_space(points.places).tolist()]
    touched = np.isin(track.keys, look.touched())
    entities.append(_entity("landmarks", stamp, spheres=spheres))
    entities.append(_entity("loop closures", stamp, lines=_closures(look, track)))
    entities.append(_entity("last step", stamp, lines=[_strip(track, touched, style.ODOMETRY, 3 * _PIXELS)]))
    return fox.SceneUpdate(entities=entities)


def _entity(name: str, stamp: fox.Timestamp, **primitives: Any) -> fox.SceneEntity:
    return fox.SceneEntity(timestamp=stamp, frame_id="map", id=name, **primitives)


def _strip(track: Track, rows: Any, colour: str = style.ESTIMATE, width: float = _PIXELS) -> fox.LinePrimitive:
    return fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineStrip,
        thickness=width,
        scale_invariant=True,
        points=_points(track.places[rows]),
        color=_colour(colour),
    )


def _closures(look: Look, track: Track) -> list[fox.LinePrimitive]:
    closures = closures_of(look.variables, look.factors)
    at = np.minimum(np.searchsorted(track.keys, closures.keys), max(len(track.keys) - 1, 0))
    if not len(at):
        return []
    there = (track.keys[at] == closures.keys).all(axis=1)
    colours = [fox.Color(r=r, g=g, b=b, a=1.0) for r, g, b in colours_of(closures.misfit[there]).tolist()]
    line = fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineList,
        thickness=_PIXELS,
        scale_invariant=True,
        points=_points(track.places[at[there]].reshape(-1, track.places.shape[1])),
        colors=[colour for colour in colours for _ in range(2)],
    )
    return [line]


def _sphere(place: list[float]) -> fox.SpherePrimitive:
    x, y, z = place
    return fox.SpherePrimitive(
        pose=fox.Pose(position=fox.Vector3(x=x, y=y, z=z), orientation=fox.Quaternion(w=1.0)),
        size=fox.Vector3(x=_LANDMARK_M, y=_LANDMARK_M, z=_LANDMARK_M),
        color=_colour(style.POINTS),
    )


def _points(places: F64) -> list[fox.Point3]:
    return [fox.Point3(x=x, y=y, z=z) for x, y, z in _in_space(places).tolist()]


def _in_space(places: F64) -> F64:
    return np.pad(places, ((0, 0), (0, 3 - places.shape[1])))


def _colour(name: str) -> fox.Color:
    r, g, b = (int(name[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return fox.Color(r=r, g=g, b=b, a=1.0)
