"""A photograph of a person under light from everywhere, with everything known about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.geometry.pinhole import camera_centers, project
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.synthetic.camera import PortraitOptions, exposure_for
from scan2albedo.synthetic.face_shape import Expression
from scan2albedo.synthetic.glossy_person import GlossyFace, GlossyPerson
from scan2albedo.synthetic.sitter import sit_down

_BEHIND_MM = 3.0
"""A landmark this much behind the surface that a ray meets first is still seen."""


@dataclass(frozen=True)
class FacePhotographOptions(PortraitOptions):
    """How the picture is taken, beside `PortraitOptions`.

    Raises `ValueError` when a value is outside its range.
    """

    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    """`azimuth_deg`, `elevation_deg`: of the camera."""
    lights: int = 256
    """Distant lights that stand for the environment, each with its shadows."""
    landmark_noise_px: float = 1.0
    """Standard deviation of the labelled landmarks."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._refuse_below_one("lights")
        self._refuse_negative("landmark_noise_px")
        if not (np.isfinite(self.azimuth_deg) and abs(self.elevation_deg) < 90):
            raise ValueError(f"the camera at {self.azimuth_deg}, {self.elevation_deg} degrees is nowhere")


@dataclass(frozen=True)
class FacePhotograph(GlossyFace):
    """A picture of a `GlossyFace`; frame: the face model's, mm."""

    image: NDArray[np.generic]
    """(S, S, 3) uint8, uint16 or float32: the picture as stored."""
    skin: BoolArray
    """(S, S): pixels that show the face, and not hair."""
    camera: FloatArray
    """(3, 4): projection matrix."""
    landmarks_px: FloatArray
    """(68, 2): labelled landmarks, with noise; NaN where they are hidden."""
    exposure: float
    options: FacePhotographOptions
    """`exposure`, `options`: as in `FlashCapture`."""


def face_photograph(
    seed: int,
    environment_linear: ArrayLike,
    *,
    expression: Expression = "neutral",
    options: FacePhotographOptions = FacePhotographOptions(),
    model: AnnotatedSurface | None = None,
) -> FacePhotograph:
    """Return a picture of the person of `flash_capture(seed)` under an environment map.

    Raises ValueError when the map has another shape or is not finite.

    Parameters
    ----------
    seed : int
        Of the person and of the noise.
    environment_linear : (H, W, 3) array_like of float
        Radiance; rows from +y down to -y, columns by azimuth from -pi to pi, from +z toward +x.
    expression : str
        As in `synthetic.face`.
    options : FacePhotographOptions
    model : AnnotatedFaceModel, optional
        The default model when omitted; it needs landmarks.
    """
    lights = DistantLights.from_environment(environment_linear, options.lights)
    sitter = sit_down(seed, expression=expression, model=model or default_model())
    person = GlossyPerson.of(sitter, hair=options.hair)
    camera = options.camera(options.azimuth_deg, options.elevation_deg)
    center = camera_centers(camera[None])[0]
    seen = person.seen(camera, center, options.picture_size)
    radiance = person.under(seen, lights)
    exposure = exposure_for(radiance[seen.on_face].max(1), options.saturated_part)
    rng = np.random.default_rng([seed, 22])
    return FacePhotograph(
        **vars(GlossyFace.truth_of(person, options.levels)),
        image=options.stored(seen.picture(exposure * radiance), rng),
        skin=seen.marked(seen.on_face),
        camera=camera,
        landmarks_px=_labels(person, camera, center, options, rng),
        exposure=exposure,
        options=options,
    )


def _labels(
    person: GlossyPerson,
    camera: FloatArray,
    center: FloatArray,
    options: FacePhotographOptions,
    rng: np.random.Generator,
) -> FloatArray:
    """Return (68, 2) pixels of landmarks, NaN where something hides them."""
    landmarks = person.sitter.face.landmarks
    pixels, _ = project(camera, landmarks)
    hidden = person.scene.hidden(center, landmarks, _BEHIND_MM)
    noisy = pixels + rng.normal(0, options.landmark_noise_px, pixels.shape)
    return np.where(hidden[:, None], np.nan, noisy)
