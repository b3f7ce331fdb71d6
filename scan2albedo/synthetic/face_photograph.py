"""A photograph of a person under light from everywhere, with everything known about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.geometry.pinhole import camera_centers, project
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.synthetic.glossy_person import GlossyPerson
from scan2albedo.synthetic.identity import Expression
from scan2albedo.synthetic.portrait import exposure_for, portrait_camera, stored_values
from scan2albedo.synthetic.sitter import sit_down

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_BEHIND_MM = 3.0
"""A landmark this much behind the surface that a ray meets first is still seen."""


@dataclass(frozen=True)
class FacePhotographOptions:
    """How the picture is taken.

    Parameters
    ----------
    azimuth_deg, elevation_deg : float
        Of the camera.
    picture_size : int
        Height and width in pixels.
    reach_mm, distance_mm : float
        Half of what the picture spans at the head, and how far away that is.
    lights : int
        Distant lights that stand for the environment, each with its shadows.
    gamma, noise, bits, saturated_part
        As in `FlashCaptureOptions`.
    landmark_noise_px : float
        Standard deviation of the labelled landmarks.
    hair : bool
    levels : int
        Of subdivision of the mesh, as in `FlashCaptureOptions`.

    Raises
    ------
    ValueError
        When a value is outside its range.
    """

    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    picture_size: int = 256
    reach_mm: float = 130.0
    distance_mm: float = 1000.0
    lights: int = 256
    gamma: float = 1.2
    noise: float = 0.01
    bits: int | None = 8
    saturated_part: float = 0.002
    landmark_noise_px: float = 1.0
    hair: bool = True
    levels: int = 1

    def __post_init__(self) -> None:
        for name in ("picture_size", "lights"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected >= 1")
        for name in ("reach_mm", "distance_mm", "gamma"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected > 0 and finite")
        for name in ("noise", "landmark_noise_px"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected >= 0 and finite")
        if not 0 <= self.saturated_part < 1:
            raise ValueError(f"saturated_part is {self.saturated_part}, expected in [0, 1)")
        if self.bits not in (8, 16, None) or self.levels not in (1, 2, 3):
            raise ValueError(f"bits is {self.bits} and levels {self.levels}, expected 8, 16 or None, 1 to 3")
        if not (np.isfinite(self.azimuth_deg) and abs(self.elevation_deg) < 90):
            raise ValueError(f"the camera at {self.azimuth_deg}, {self.elevation_deg} degrees is nowhere")


@dataclass(frozen=True)
class FacePhotograph:
    """Frame: the face model's, mm.

    Parameters
    ----------
    image : (S, S, 3) uint8, uint16 or float32
        Values.
    skin : (S, S) bool
        Pixels that show the face, and not hair.
    camera : (3, 4) float64
        Projection matrix.
    landmarks_px : (68, 2) float64
        Labelled landmarks, with noise; NaN where they are hidden.
    vertices, normals, faces, landmarks, diffuse_linear, weights, exposure
        As in `FlashCapture`.
    options : FacePhotographOptions
    """

    image: NDArray[np.generic]
    skin: NDArray[np.bool_]
    camera: FloatArray
    landmarks_px: FloatArray
    vertices: FloatArray
    normals: FloatArray
    faces: IntArray
    landmarks: FloatArray
    diffuse_linear: FloatArray
    weights: FloatArray
    exposure: float
    options: FacePhotographOptions


def face_photograph(
    seed: int,
    environment_linear: ArrayLike,
    *,
    expression: Expression = "neutral",
    options: FacePhotographOptions = FacePhotographOptions(),
    model: AnnotatedFaceModel | None = None,
) -> FacePhotograph:
    """Photograph the person of `flash_capture(seed)` under an environment map.

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

    Returns
    -------
    FacePhotograph

    Raises
    ------
    ValueError
        When the map has another shape or is not finite.

    Examples
    --------
    >>> few = FacePhotographOptions(picture_size=48, lights=4)
    >>> face_photograph(0, np.ones((4, 8, 3)), options=few).image.shape
    (48, 48, 3)
    """
    lights = DistantLights.from_environment(environment_linear, options.lights)
    face_model = model or AnnotatedFaceModel.default()
    sitter = sit_down(seed, expression=expression, model=face_model)
    person = GlossyPerson.of(sitter, hair=options.hair)
    camera = portrait_camera(
        options.azimuth_deg,
        options.elevation_deg,
        size=options.picture_size,
        distance_mm=options.distance_mm,
        reach_mm=options.reach_mm,
    )
    center = camera_centers(camera[None])[0]
    seen = person.seen(camera, center, options.picture_size)
    radiance = person.under(seen, lights)
    exposure = exposure_for(radiance[seen.on_face].max(1), options.saturated_part)
    rng = np.random.default_rng([seed, 22])
    subdivision = face_model.subdivision(options.levels)
    count = subdivision.matrix.shape[0]
    return FacePhotograph(
        image=stored_values(
            seen.picture(exposure * radiance),
            gamma=options.gamma,
            noise=options.noise,
            bits=options.bits,
            rng=rng,
        ),
        skin=seen.marked(seen.on_face),
        camera=camera,
        landmarks_px=_labels(person, camera, center, options, rng),
        vertices=sitter.face.vertices[:count],
        normals=sitter.normals[:count],
        faces=subdivision.faces,
        landmarks=sitter.face.landmarks,
        diffuse_linear=person.diffuse_linear[:count],
        weights=person.weights[:count],
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
    offset = landmarks - center
    distance = np.linalg.norm(offset, axis=1)
    origins = np.broadcast_to(center, landmarks.shape)
    hidden = person.scene.occluded(origins, offset / distance[:, None], distance - _BEHIND_MM)
    noisy = pixels + rng.normal(0, options.landmark_noise_px, pixels.shape)
    return np.where(hidden[:, None], np.nan, noisy)
