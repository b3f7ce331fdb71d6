"""Lenses in a registered frame, over a head, for one or more cameras."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import (
    Camera,
    InsertedLens,
    LensMaterial,
    LensPicture,
    LensPictureOptions,
    Surface,
    insert_lenses,
)
from scan2albedo.eyeglasses.checks import checked_keypoints
from scan2albedo.eyeglasses.lenses.inserted_lenses import without_glass, worn_axes
from scan2albedo.eyeglasses.lenses.lens_picture import checked_image
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.environment import texel_directions, texel_solid_angles

_LAMPS = (
    ((-0.6, 0.6, 0.7), 0.82, 7.0),
    ((0.9, 0.15, 0.6), 0.86, 1.6),
    ((0.15, 0.95, -0.45), 0.86, 3.0),
)
"""Direction (to the wearer's left, up, to the front), cosine of half the angle and radiance of each soft
lamp: key, fill, and one above the sitter."""
_SOFTNESS = 0.08
"""Cosines over which a lamp's edge fades."""

EnvironmentKind = Literal["given", "built-in", "none"]
_WORN_MM = 150.0
"""Largest distance between a worn frame's rims and the head: more is another world, or another unit."""
WHITE_SHOWN = 0.9
"""Part of a preview's white as which a white plate that faces as the frame does is shown."""


def soft_environment(axes: ArrayLike, *, rows: int = 128) -> FloatArray:
    """Return a neutral map (rows, 2 rows, 3): an even room, brighter above, with three soft lamps.

    `axes` (3, 3) are those of `worn_axes`: lamps stand around whoever wears the frame, wherever a camera is,
    the main one on the wearer's right, which pictures show on the left.
    """
    seen = texel_directions((rows, 2 * rows)) @ np.asarray(axes, np.float64).T
    radiance = 0.4 + 0.2 * seen[..., 1]
    for direction, edge, strength in _LAMPS:
        rise = np.clip((seen @ normalized(np.array(direction)) - edge) / _SOFTNESS + 0.5, 0, 1)
        radiance = radiance + strength * rise * rise * (3 - 2 * rise)
    return np.repeat(radiance[..., None], 3, 2)


def white_exposure(environment_linear: FloatArray, front: FloatArray) -> float:
    """Return the factor that shows a matte white plate facing `front` (3,) as `WHITE_SHOWN` of white.

    Nothing hides the plate, so that an environment (H, W, 3) has one exposure for all cameras and heads.
    Where it gets less light than a plate does on average over all directions, that average counts; 1 in the
    dark.
    """
    rows, columns = environment_linear.shape[:2]
    light = environment_linear.mean(2) * texel_solid_angles(rows, columns)[:, None]
    facing = np.maximum(texel_directions((rows, columns)) @ front, 0.0)
    radiance = max(float((light * facing).sum()), float(light.sum()) / 4) / np.pi
    return WHITE_SHOWN / radiance if radiance > 0 else 1.0


@dataclass(frozen=True)
class LensView:
    """A view with lenses in it."""

    camera: Camera
    picture: LensPicture
    seconds: float


@dataclass(frozen=True)
class RenderedLenses:
    """What `render_lenses` made."""

    views: tuple[LensView, ...]
    frame: Surface
    """Without glass of its own where a lens is."""
    environment: EnvironmentKind
    from_photographs: bool
    options: LensPictureOptions
    exposure: float
    """Factor on linear colours for previews, the same for all views: `white_exposure`, 1 for photographs."""

    @property
    def lenses(self) -> tuple[InsertedLens, ...]:
        """The lenses, the same in all views."""
        return self.views[0].picture.lenses

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of all views; those that only some have name them. The last is on the exposure."""
        count = len(self.views)
        said: dict[str, list[str]] = {}
        for view in self.views:
            for note in view.picture.notes:
                said.setdefault(note, []).append(view.camera.name)
        notes = [n if len(names) == count else f"{', '.join(names)}: {n}" for n, names in said.items()]
        if not self.from_photographs:
            notes.append(
                f"pictures show linear colours times {self.exposure:.3g}: under this light a white plate "
                f"that faces as the frame does is {WHITE_SHOWN:g} of white, whichever views are chosen"
            )
        return tuple(notes)


def render_lenses(
    frame: Surface,
    keypoints: ArrayLike,
    lenses: LensMaterial | tuple[LensMaterial | None, LensMaterial | None],
    *,
    head: Surface,
    cameras: Sequence[Camera],
    pictures_linear: Sequence[ArrayLike] | None = None,
    environment_linear: ArrayLike | None = None,
    options: LensPictureOptions = LensPictureOptions(),
    on_view: Callable[[LensView], None] | None = None,
) -> RenderedLenses:
    """Put lenses into a frame that sits on a head, and show them to one camera or more.

    Frame, key points (20, 3) and head are in one world, in mm, such as ``Surface(registered.vertices,
    faces)`` of a `RegisteredEyeglasses`. Lenses, photographs (one a camera) and environment are those of
    `insert_lenses`; drawn views without an environment get `soft_environment`. `on_view` is called with each
    view when it is done. Raises EyeglassesError as from `insert_lenses`, and when frame and head lie apart;
    ValueError when there is no camera, or not a picture of its shape for each.
    """
    if not cameras:
        raise ValueError("give a camera")
    photographs = _photographs(cameras, pictures_linear)
    _check_worn(np.asarray(keypoints, np.float64), head)
    kind: EnvironmentKind = "given"
    if environment_linear is None:
        kind = "none" if pictures_linear is not None else "built-in"
    marks, exposure = np.asarray(keypoints, np.float64), 1.0
    if pictures_linear is None:
        axes = worn_axes(np.asarray(frame.vertices), checked_keypoints("keypoints", keypoints))
        if environment_linear is None:
            environment_linear = soft_environment(axes)
        exposure = white_exposure(checked_image("environment_linear", environment_linear), axes[2])
    views = []
    for camera, photograph in zip(cameras, photographs, strict=True):
        begun = time.perf_counter()
        picture = insert_lenses(
            frame,
            keypoints,
            lenses,
            surfaces=[head],
            camera=camera.matrix,
            shape=camera.shape if photograph is None else None,
            picture_linear=photograph,
            environment_linear=environment_linear,
            options=options,
        )
        views.append(LensView(camera, picture, time.perf_counter() - begun))
        if on_view is not None:
            on_view(views[-1])
    bare = without_glass(frame, views[0].picture.lenses, marks)[0]
    return RenderedLenses(tuple(views), bare, kind, pictures_linear is not None, options, exposure)


def _photographs(
    cameras: Sequence[Camera], pictures: Sequence[ArrayLike] | None
) -> Sequence[FloatArray | None]:
    if pictures is None:
        return [None] * len(cameras)
    if len(pictures) != len(cameras):
        raise ValueError(f"there are {len(pictures)} pictures for {len(cameras)} cameras")
    images = [np.asarray(picture, np.float64) for picture in pictures]
    for image, camera in zip(images, cameras, strict=True):
        if image.shape != (*camera.shape, 3):
            raise ValueError(
                f"the picture of {camera.name!r} is {image.shape}, expected {(*camera.shape, 3)}"
            )
    return images


def _check_worn(keypoints: FloatArray, head: Surface) -> None:
    """Refuse a frame that is not at the head."""
    known = keypoints[np.isfinite(keypoints).all(1)] if keypoints.ndim == 2 else keypoints[:0]
    if len(known) == 0:
        return
    query = ClosestPointQuery(np.asarray(head.vertices), np.asarray(head.faces))
    apart = float(np.median(query.query(known).distance))
    if apart > _WORN_MM:
        raise EyeglassesError(
            f"the frame lies {apart:.0f} mm away from the head; give both in the same world, and their units"
        )
