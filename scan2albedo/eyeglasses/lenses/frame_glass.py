"""Glass that a frame's mesh holds where lenses are to go: it would hide them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.lenses.inserted_lenses import InsertedLens, rim_key_points
from scan2albedo.eyeglasses.lenses.lens_panes import is_covered, pane_faces
from scan2albedo.eyeglasses.lenses.lens_plane import LensPlane
from scan2albedo.eyeglasses.lenses.lens_scene import Surface

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class BareFrame:
    """A frame without glass where lenses go."""

    surface: Surface
    kept: NDArray[np.bool_]
    """(F,) which faces of the frame are left."""
    notes: tuple[str, ...]
    """What was left out, and what still covers a lens."""


def without_glass(frame: Surface, lenses: Sequence[InsertedLens], keypoints: FloatArray) -> BareFrame:
    """Take the parts out of a frame that lie across a lens, as `find_lens_rim` looks through them.

    Glass of one piece with the rim stays, and a note tells it.
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
    return BareFrame(_with_faces(frame, kept), kept, tuple(notes))


def _with_faces(surface: Surface, kept: NDArray[np.bool_]) -> Surface:
    if kept.all():
        return surface
    uv = None if surface.uv is None else np.asarray(surface.uv)
    return replace(
        surface,
        faces=np.asarray(surface.faces)[kept],
        uv=uv[kept] if uv is not None and uv.ndim == 3 else uv,
    )
