"""The 20 key points of a pair of glasses: names, bones, mirror images; checks of arrays that callers give."""

import itertools
import json
from importlib import resources
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order

from scan2albedo.core import arrays
from scan2albedo.core.arrays import ArrayLike, FloatArray, IntArray, Texts
from scan2albedo.errors import EyeglassesError


class KeyPointPlace(NamedTuple):
    """Where a key point goes, those of a side once; `absent` says what to do if the frame has none.

    `typical_mm` is the left one's place on a typical frame: x to the wearer's left, y up, z to the front.
    """

    name: str
    where: str
    spot: str
    absent: str
    typical_mm: tuple[float, float, float]


_ROWS = json.loads(resources.files(__package__).joinpath("data/key_points.json").read_text("utf-8"))
KEY_POINT_PLACES = tuple(KeyPointPlace(**row) for row in _ROWS)
"""Where the key points go, those of a side once."""
_SIDE = tuple(place.name for place in KEY_POINT_PLACES[2:])
KEY_POINT_NAMES: Texts = (
    *(place.name for place in KEY_POINT_PLACES[:2]),
    *(f"{side}_{name}" for side in ("left", "right") for name in _SIDE),
)
"""Names in the order of all (20, 3) arrays. Left and right are the wearer's."""
KEY_POINT_COUNT = len(KEY_POINT_NAMES)
MIRROR: IntArray = np.array([0, 1, *range(11, 20), *range(2, 11)])
"""Index of each key point's counterpart on the other side."""

_RING = ("hinge", "rim_top", "rim_bridge", "rim_inner", "rim_bottom", "rim_outer", "hinge")
_TEMPLE = ("hinge", "temple_middle", "ear_bend", "temple_tip")


_BONES = [("bridge_top", "bridge_bottom")]
for _side in ("left", "right"):
    for _chain in (_RING, _TEMPLE):
        _BONES += [(f"{_side}_{a}", f"{_side}_{b}") for a, b in itertools.pairwise(_chain)]
    _BONES += [(f"bridge_{end}", f"{_side}_rim_bridge") for end in ("top", "bottom")]
SKELETON = tuple((KEY_POINT_NAMES.index(a), KEY_POINT_NAMES.index(b)) for a, b in _BONES)
"""Pairs of key points that one stretch of the frame joins: both rims, the bridge, both temples."""


_JOINED = csr_matrix((np.ones(len(SKELETON)), np.array(SKELETON).T), shape=(KEY_POINT_COUNT,) * 2)
PARENTS = tuple(np.maximum(breadth_first_order(_JOINED + _JOINED.T, 0)[1], -1).tolist())
"""Each key point's parent in a tree of bones that hangs on the top of the bridge, whose own is -1."""


def typical_key_points() -> FloatArray:
    """Return the key points (20, 3) of a typical frame in mm: x to the left, y up, z to the front."""
    left = np.array([place.typical_mm for place in KEY_POINT_PLACES], float)
    return np.concatenate([left, left[2:] * [-1, 1, 1]])


def checked_points(name: str, values: ArrayLike) -> FloatArray:
    """Return finite points (N, 3), N >= 1; EyeglassesError for none or not finite, ValueError for a shape."""
    if np.size(values) == 0:
        raise EyeglassesError(f"{name} hold nothing; give one or more")
    points = arrays.checked_array(values, ("N", 3), name, finite=EyeglassesError)
    return np.ascontiguousarray(points)


def checked_mesh(
    vertices: ArrayLike, faces: ArrayLike, owner: str = "the mesh"
) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of a mesh with faces; messages begin with its `owner`.

    Raises EyeglassesError when it is empty or not finite, ValueError when arrays do not fit together.
    """
    xyz = checked_points(f"{owner}: vertices", vertices)
    if np.size(faces) == 0:
        raise EyeglassesError(f"{owner}: no faces; give a mesh with faces")
    index = arrays.checked_array(faces, ("F", 3), f"{owner}: faces", kind=int)
    return arrays.checked_mesh(xyz, index, owner)


def checked_keypoints(name: str, values: ArrayLike) -> FloatArray:
    """Return key points (20, 3) as a new array; raises ValueError for another shape."""
    return np.array(arrays.checked_array(values, (KEY_POINT_COUNT, 3), name))


def checked_weights(name: str, values: ArrayLike, count: int) -> FloatArray:
    """Return finite weights (V, 20) of `count` vertices; raises ValueError for others."""
    shape = (count, KEY_POINT_COUNT)
    return np.ascontiguousarray(arrays.checked_array(values, shape, name, finite=ValueError))
