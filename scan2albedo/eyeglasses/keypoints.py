"""The 20 key points of a pair of glasses: their names, what connects them, which mirror each other."""

from __future__ import annotations

_SIDE = (
    "rim_top",
    "rim_bridge",
    "rim_inner",
    "rim_bottom",
    "rim_outer",
    "hinge",
    "temple_middle",
    "ear_bend",
    "temple_tip",
)
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
    "bridge_top",
    "bridge_bottom",
    *(f"{side}_{name}" for side in ("left", "right") for name in _SIDE),
)
"""Names in the order of all (20, 3) arrays. Left and right are the wearer's. Of each rim: its top and bottom,
where the bridge meets it, below that the side at the nose, and the side at the temple."""
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
