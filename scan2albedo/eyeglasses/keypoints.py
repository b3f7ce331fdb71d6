"""The 20 key points of a pair of glasses: their names, what connects them, which mirror each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import FloatArray


@dataclass(frozen=True)
class KeyPointPlace:
    """Where a key point goes: of the frame's middle, or of each side (`name` without the side)."""

    name: str
    where: str
    spot: str
    """On the surface, or in the middle of the tube."""
    absent: str
    """What to do if the frame has none."""
    typical_mm: tuple[float, float, float]
    """On a typical frame, of the left one: x to the wearer's left, y up, z to the front."""


_LEFT_OUT = "leave out, or null"
_RIMLESS = "rimless: the same place on the lens's edge; without lenses null"
_BRIDGE_PLACES = (
    KeyPointPlace(
        "bridge_top",
        "top of the bridge, in its middle; of two bridges the upper one",
        "surface",
        _LEFT_OUT,
        (0, 15, 0),
    ),
    KeyPointPlace(
        "bridge_bottom",
        "underside of the bridge, in its middle; of two bridges the lower one",
        "surface",
        _LEFT_OUT,
        (0, 10, 0),
    ),
)
_SIDE_PLACES = (
    KeyPointPlace("rim_top", "highest place of the rim", "surface, outside", _RIMLESS, (37, 22, -3)),
    KeyPointPlace(
        "rim_bridge", "where the (lower) bridge meets the rim", "surface, lens side", _RIMLESS, (14, 10, 0)
    ),
    KeyPointPlace(
        "rim_inner",
        "the rim's side at the nose, below the bridge",
        "surface, outside",
        _RIMLESS,
        (12, -13, 0),
    ),
    KeyPointPlace("rim_bottom", "lowest place of the rim", "surface, outside", _RIMLESS, (37, -22, -3)),
    KeyPointPlace(
        "rim_outer",
        "the rim's side at the temple, below the hinge",
        "surface, outside",
        _RIMLESS,
        (62, -13, -7),
    ),
    KeyPointPlace(
        "hinge",
        "where the temple leaves the front",
        "surface, outside",
        "no temples: the front's outermost place",
        (68, 11, -8),
    ),
    KeyPointPlace(
        "temple_middle",
        "half way from the hinge to the ear bend",
        "surface, outside",
        "no temples: leave out, or null",
        (71, 11, -62),
    ),
    KeyPointPlace(
        "ear_bend",
        "where the temple turns down behind the ear; of a straight one two thirds from the hinge to the tip",
        "surface, outside",
        "no temples: leave out, or null",
        (74, 8, -117),
    ),
    KeyPointPlace(
        "temple_tip",
        "end of the temple",
        "middle of the end",
        "no temples: leave out, or null",
        (74, -18, -144),
    ),
)
KEY_POINT_PLACES = (*_BRIDGE_PLACES, *_SIDE_PLACES)
"""Where the key points go, those of a side once."""
_SIDE_BONES = (
    ("hinge", "rim_top"),
    ("rim_top", "rim_bridge"),
    ("rim_bridge", "rim_inner"),
    ("rim_inner", "rim_bottom"),
    ("rim_bottom", "rim_outer"),
    ("rim_outer", "hinge"),
    ("hinge", "temple_middle"),
    ("temple_middle", "ear_bend"),
    ("ear_bend", "temple_tip"),
)

KEY_POINT_NAMES: tuple[str, ...] = (
    *(place.name for place in _BRIDGE_PLACES),
    *(f"{side}_{place.name}" for side in ("left", "right") for place in _SIDE_PLACES),
)
"""Names in the order of all (20, 3) arrays. Left and right are the wearer's; `KEY_POINT_PLACES` says where
they go."""
KEY_POINT_COUNT = len(KEY_POINT_NAMES)

MIRROR: tuple[int, ...] = (0, 1, *range(11, 20), *range(2, 11))
"""Index of each key point's counterpart on the other side."""


def _bones() -> tuple[tuple[int, int], ...]:
    number = {name: index for index, name in enumerate(KEY_POINT_NAMES)}
    pairs = [("bridge_top", "bridge_bottom")]
    for side in ("left", "right"):
        pairs += [(f"{side}_{a}", f"{side}_{b}") for a, b in _SIDE_BONES]
        pairs += [(f"bridge_{end}", f"{side}_rim_bridge") for end in ("top", "bottom")]
    return tuple((number[a], number[b]) for a, b in pairs)


SKELETON: tuple[tuple[int, int], ...] = _bones()
"""Pairs of key points that one stretch of the frame joins: both rims, the bridge, both temples."""


def _tree(root: int) -> tuple[int, ...]:
    """Return each key point's parent on the shortest way to the root, -1 for the root itself."""
    parents, queue = {root: -1}, [root]
    for joint in queue:
        for neighbour in sorted(j for bone in SKELETON if joint in bone for j in bone):
            if neighbour not in parents:
                parents[neighbour] = joint
                queue.append(neighbour)
    return tuple(parents[k] for k in range(KEY_POINT_COUNT))


PARENTS: tuple[int, ...] = _tree(0)
"""A tree of bones that hangs on the top of the bridge: rims and bridge are circles, cut once each."""


def typical_key_points() -> FloatArray:
    """Return the key points (20, 3) of a typical frame in mm: x to the left, y up, z to the front."""
    left = np.array([place.typical_mm for place in KEY_POINT_PLACES], np.float64)
    return np.concatenate([left, left[len(_BRIDGE_PLACES) :] * [-1, 1, 1]])


def key_point_rows() -> list[tuple[str, str, str, str]]:
    """Return the table of key points: names, places, spots on the tube, and what to do if there is none."""
    return [
        (
            place.name if place in _BRIDGE_PLACES else f"left_{place.name}, right_{place.name}",
            place.where,
            place.spot,
            place.absent,
        )
        for place in KEY_POINT_PLACES
    ]
