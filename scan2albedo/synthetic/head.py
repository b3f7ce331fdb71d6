"""Continue a face mask to a head: back over the skull from its upper rim, down a neck from its chin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.geometry.mesh import normalized
from scan2albedo.synthetic.clutter import SKULL_CENTER_FROM_NOSE_MM, SKULL_SEMI_AXES_MM, grid_faces, nose_tip
from scan2albedo.synthetic.textures import smoothstep

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NECK_RADII_MM = (62.0, 60.0)
_NECK_AXIS_BEHIND_NOSE_MM = 118.0
_NECK_BASE_BELOW_NOSE_MM = 190.0


def head_around(
    vertices: FloatArray, faces: IntArray, normals: FloatArray, *, rings: int = 60
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return skull and neck as one collar around a face's rim.

    Parameters
    ----------
    vertices, faces, normals : (V, 3) mm, (F, 3), (V, 3)
        A disc-shaped face looking along +z.
    rings : int
        Rings of vertices from the rim outward, the rim included.

    Returns
    -------
    vertices : (rings B, 3) float64
        Ring by ring, ring 0 on the rim's B vertices.
    faces : (F', 3) int64
    uv : (rings B, 2) float64
        Around and along, in units of the face's chart (about 1 for 200 mm).
    """
    loop = boundary_loop(faces)
    rim, tip = vertices[loop], nose_tip(vertices)
    outward = _conormals(vertices, normals, loop)
    share = np.linspace(0, 1, rings)[:, None, None]
    middle_y = (rim[:, 1].max() + rim[:, 1].min()) / 2
    # 0 at the crown, pi at the chin.
    angle = np.abs(np.arctan2(rim[:, 0], rim[:, 1] - middle_y))
    chin = smoothstep((angle - np.deg2rad(95)) / np.deg2rad(40))[None, :, None]
    collar = (1 - chin) * _skull_paths(rim, outward, tip, share) + chin * _neck_paths(
        rim, outward, tip, share
    )
    around = np.cumsum(np.linalg.norm(rim - np.roll(rim, 1, axis=0), axis=1))
    uv = np.stack(np.broadcast_arrays(around[None] / 200, share[..., 0]), -1)
    return collar.reshape(-1, 3), grid_faces(rings, len(loop), wrap=True), uv.reshape(-1, 2)


def boundary_loop(faces: IntArray) -> IntArray:
    """Return the vertices of a disc's boundary, counter-clockwise seen from outside.

    >>> boundary_loop(np.array([[0, 1, 2], [0, 2, 3]])).tolist()
    [0, 1, 2, 3]
    """
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    count = int(faces.max()) + 1
    forth, back = directed @ [count, 1], directed @ [1, count]
    following = dict(directed[~np.isin(forth, back)].tolist())
    loop = [min(following)]
    while following[loop[-1]] != loop[0]:
        loop.append(following[loop[-1]])
    if len(loop) != len(following):
        raise ValueError(
            f"the mesh has {len(following)} boundary vertices but one loop holds {len(loop)} of them"
        )
    return np.array(loop)


def _conormals(vertices: FloatArray, normals: FloatArray, loop: IntArray) -> FloatArray:
    """Return (B, 3) unit vectors that leave the surface across its rim, smoothed along it."""
    rim = vertices[loop]
    along = np.roll(rim, -1, axis=0) - np.roll(rim, 1, axis=0)
    outward = normalized(np.cross(along, normals[loop]))
    for _ in range(12):
        outward = normalized(outward + np.roll(outward, 1, axis=0) + np.roll(outward, -1, axis=0))
    return outward


def _skull_paths(rim: FloatArray, outward: FloatArray, tip: FloatArray, share: FloatArray) -> FloatArray:
    """Return (S, B, 3): from the rim, along its own slope, onto an ellipsoid and toward its back."""
    center = tip + SKULL_CENTER_FROM_NOSE_MM
    start = normalized(rim - center)
    sway = share * 1.15
    direction = normalized((1 - sway) * start + sway * np.array([0.0, 0.1, -1.0]) + 1e-9)
    skull = center + direction / np.linalg.norm(direction / SKULL_SEMI_AXES_MM, axis=-1, keepdims=True)
    straight = rim + outward * share * 200
    return straight + (skull - straight) * smoothstep(share / 0.3)


def _neck_paths(rim: FloatArray, outward: FloatArray, tip: FloatArray, share: FloatArray) -> FloatArray:
    """Return (S, B, 3): Hermite curves from the rim under the chin to an ellipse at the neck's base."""
    sideways = rim[:, 0] / np.abs(rim[:, 0]).max()
    turn = sideways * np.deg2rad(120)
    base = np.stack(
        [
            tip[0] + _NECK_RADII_MM[0] * np.sin(turn),
            np.full(len(rim), tip[1] - _NECK_BASE_BELOW_NOSE_MM),
            tip[2] - _NECK_AXIS_BEHIND_NOSE_MM + _NECK_RADII_MM[1] * np.cos(turn),
        ],
        1,
    )
    leave = outward * 110 + np.array([0.0, 0.0, -60.0])
    arrive = np.array([0.0, -170.0, 0.0]) + 110 * sideways[:, None] * np.array([1.0, 0.0, 0.0])
    s = share
    return (
        (2 * s**3 - 3 * s**2 + 1) * rim
        + (s**3 - 2 * s**2 + s) * leave
        + (3 * s**2 - 2 * s**3) * base
        + (s**3 - s**2) * arrive
    )
