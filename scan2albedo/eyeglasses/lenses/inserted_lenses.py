"""Lenses that fill the rims of a frame, and the glass of its own that makes room for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.lenses.optics import LensMaterial, ThinLens
from scan2albedo.eyeglasses.lenses.rims import (
    LensPlane,
    LensRim,
    find_lens_rim,
    fit_normal,
    is_covered,
    pane_faces,
)
from scan2albedo.eyeglasses.lenses.scenes import Surface
from scan2albedo.geometry.mesh import face_cross_products, normalized
from scan2albedo.geometry.rays import RayCaster

SIDES = ("left", "right")
_BEHIND = ("hinge", "temple_middle", "ear_bend", "temple_tip")
_RADII_MM = (5.0, 100.0)
"""Mean radii of lenses, a reader's slit to a diving mask: others are not millimetres."""


@dataclass(frozen=True)
class InsertedLens:
    """A lens in its rim; mm in the world's frame."""

    side: int
    """0 is the wearer's left, 1 the right."""
    material: LensMaterial
    """Power, tint and reflection."""
    rim: LensRim
    """The edge that it fills."""
    vertices: FloatArray
    """(R + 1, 3), the centre first; rim points moved into their seat."""
    faces: IntArray
    """(R, 3)."""
    optics: ThinLens
    """In the plane nearest to the rim; the normal towards the viewer of the front."""
    caster: RayCaster
    """Of the lens alone."""

    @property
    def name(self) -> str:
        """Whose lens it is, for messages."""
        return f"{SIDES[self.side]} lens"


def insert_lens(
    vertices: FloatArray,
    faces: IntArray,
    keypoints: FloatArray,
    side: int,
    material: LensMaterial,
    *,
    center: FloatArray | None = None,
    seat_mm: float = 0.0,
) -> InsertedLens:
    """Return the lens that fills one rim of a frame; lengths in mm.

    Of the key points (20, 3) those of the rim are needed, others may be NaN. The optical `center` (3,) is
    moved into the lens plane along its normal; the outline's centroid when omitted. Points of
    the outline that were measured move `seat_mm` outward, into the rim.

    Raises EyeglassesError, naming the lens, when key points of the rim are missing, no rim is found, or its
    size is not a lens's in mm.
    """
    marks = rim_key_points(keypoints, side)
    top, bridge, inner, bottom, outer = marks
    # Three of the five lie on the nose's side, so their mean would be off.
    guess = (top + bottom) / 4 + (bridge + inner) / 8 + outer / 4
    try:
        normal = _viewers_side(fit_normal(marks, vertices), guess, keypoints)
        rim = find_lens_rim(vertices, faces, guess, rim_points=marks, normal=normal)
        # The rim's own plane and the area's centroid in it take the place of what they were guessed to be.
        middle = rim.points.mean(0)
        axis = np.linalg.svd(rim.points - middle, full_matrices=False)[2][2]
        axis = axis * np.sign(axis @ rim.normal)
        plane = LensPlane.at(middle, axis)
        x, y = (rim.points - middle) @ plane.across, (rim.points - middle) @ plane.up
        twice_area = x * np.roll(y, -1) - np.roll(x, -1) * y
        cx, cy = (((p + np.roll(p, -1)) * twice_area).sum() / (3 * twice_area.sum()) for p in (x, y))
        rim = replace(rim, normal=axis, center=middle + cx * plane.across + cy * plane.up)
        radius = float(np.linalg.norm(rim.points - rim.center, axis=1).mean())
        if not _RADII_MM[0] <= radius <= _RADII_MM[1]:
            raise EyeglassesError(
                f"its mean radius is {radius:.3g} mm, which no lens has; give everything in millimetres, "
                "for the power in dioptres depends on it"
            )
        plane = LensPlane.at(rim.center, rim.normal)
        outward = plane.directions(plane.angles(rim.points))
        seated = rim.points + seat_mm * rim.measured[:, None] * outward
        fan, triangles = lens_mesh(rim.center, seated, rim.normal)
    except EyeglassesError as error:
        raise EyeglassesError(f"the {SIDES[side]} lens: {error}") from error
    at = rim.center if center is None else center - ((center - rim.center) @ rim.normal) * rim.normal
    optics = ThinLens(at, rim.normal, material.dioptres)
    return InsertedLens(side, material, rim, fan, triangles, optics, RayCaster(fan, triangles))


def rim_key_points(keypoints: FloatArray, side: int) -> FloatArray:
    """Return a rim's key points (5, 3): top, bridge, inner, bottom, outer.

    Raises EyeglassesError, naming key point and lens, when one is missing.
    """
    wanted = _rim(side)
    marks = keypoints[wanted]
    missing = [KEY_POINT_NAMES[i] for i in wanted if not np.isfinite(keypoints[i]).all()]
    if missing:
        raise EyeglassesError(
            f"the {SIDES[side]} lens needs the key points of its rim, but {', '.join(missing)} "
            f"{'is' if len(missing) == 1 else 'are'} missing; give them, or None in place of this lens"
        )
    return marks


def worn_axes(vertices: FloatArray, keypoints: FloatArray) -> FloatArray:
    """Return unit vectors (3, 3) of a frame: to the wearer's left, up, to the front.

    Of its rims, one at least; raises EyeglassesError, naming key points, when none is known.
    """
    known = [side for side in (0, 1) if np.isfinite(keypoints[_rim(side)]).all()]
    front, up = np.zeros(3), np.zeros(3)
    for side in known or [0]:
        marks = rim_key_points(keypoints, side)
        front += _viewers_side(fit_normal(marks, vertices), marks.mean(0), keypoints)
        up += marks[0] - marks[3]
    front = normalized(front)
    up = normalized(up - (up @ front) * front)
    return np.array([np.cross(up, front), up, front])


def _rim(side: int) -> list[int]:
    return [i for i, n in enumerate(KEY_POINT_NAMES) if n.startswith(f"{SIDES[side]}_rim_")]


def _viewers_side(normal: FloatArray, center: FloatArray, keypoints: FloatArray) -> FloatArray:
    """Return the normal away from the temples' key points, where there are any."""
    behind = keypoints[[i for i, n in enumerate(KEY_POINT_NAMES) if n.endswith(_BEHIND)]]
    behind = behind[np.isfinite(behind).all(1)]
    if len(behind) == 0:
        return normal
    return -normal if (behind.mean(0) - center) @ normal > 0 else normal


def lens_mesh(
    center: ArrayLike, rim: ArrayLike, normal: ArrayLike | None = None
) -> tuple[FloatArray, IntArray]:
    """Return vertices (R + 1, 3) and faces (R, 3) of a fan from the centre to the rim.

    Normals point to the side from which the rim runs counterclockwise, the viewer's for
    `LensRim.points`; with `normal` the fan is turned so that they point along it.

    `center` (3,) becomes vertex 0; `rim` (R, 3), R >= 3, runs in order around the lens. EyeglassesError when
    it does not go around the centre once, so that the fan would fold; ValueError when an array has the wrong
    shape or is not finite.

    Examples
    --------
    >>> vertices, faces = lens_mesh([0, 0, 0], [[1, 0, 0], [0, 1, 0], [-1, -1, 0]])
    >>> vertices.shape, faces.tolist()
    ((4, 3), [[0, 1, 2], [0, 2, 3], [0, 3, 1]])
    """
    middle, outline = np.asarray(center, np.float64), np.asarray(rim, np.float64)
    if middle.shape != (3,) or outline.ndim != 2 or outline.shape[1] != 3 or len(outline) < 3:
        raise ValueError(f"center and rim must be (3,) and (R, 3), got {middle.shape}, {outline.shape}")
    vertices = np.concatenate([middle[None], outline])
    if not np.isfinite(vertices).all():
        raise ValueError("center and rim must be finite")
    numbers = np.arange(1, len(vertices))
    faces = np.stack([np.zeros_like(numbers), numbers, np.roll(numbers, -1)], 1)
    # Taken around the centre: far from the origin the cross products would lose their digits.
    cross = face_cross_products(vertices - middle, faces)
    axis = cross.sum(0)
    if normal is not None and np.asarray(normal, np.float64) @ axis < 0:
        faces, cross, axis = faces[:, [0, 2, 1]], -cross, -axis
    folded = ~(cross @ axis > 0)
    if folded.any():
        raise EyeglassesError(
            f"the rim does not go around the lens centre once: {int(folded.sum())} of {len(faces)} triangles "
            "fold; move the centre inside, or put the points in order"
        )
    return vertices, faces


def without_glass(
    frame: Surface, lenses: Sequence[InsertedLens], keypoints: FloatArray
) -> tuple[Surface, tuple[str, ...]]:
    """Return a frame without the parts that lie across a lens, and notes.

    Glass of one piece with the rim stays, and a note says so.
    """
    vertices, faces = np.asarray(frame.vertices), np.asarray(frame.faces)
    kept, notes = np.ones(len(faces), bool), []
    for lens in lenses:
        plane = LensPlane.at(lens.rim.center, lens.rim.normal)
        marks = rim_key_points(keypoints, lens.side)
        panes = pane_faces(vertices, faces[kept], plane, marks)
        if panes.any():
            kept[np.flatnonzero(kept)[panes]] = False
            notes.append(
                f"the {lens.name}: the frame's own glass there, {int(panes.sum())} faces, is left out"
            )
        if is_covered(vertices, faces[kept], plane, marks):
            notes.append(
                f"the {lens.name}: the frame covers it, it seems by glass of one piece with the rim, which "
                "may have been taken for the rim; cut it out of the mesh"
            )
    if kept.all():
        return frame, tuple(notes)
    uv = None if frame.uv is None else np.asarray(frame.uv)
    uv = uv[kept] if uv is not None and uv.ndim == 3 else uv
    return replace(frame, faces=faces[kept], uv=uv), tuple(notes)
