"""A synthetic person who wears glasses, seen by calibrated cameras, with everything known about it."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, finite_rows
from scan2albedo.face_model import default_model
from scan2albedo.geometry.pinhole import camera_centers, look_at, pixel_directions, pixel_grid, project
from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points
from scan2albedo.synthetic.glasses import GlassesBend, GlassesShape, SyntheticEyeglasses, eyeglasses
from scan2albedo.synthetic.renderer import RayScene, toward
from scan2albedo.synthetic.sitter import BodyPart, Sitter, compact, join, sit_down

_FAR_MM = 300.0
_CLEARANCE_MM = 0.4
"""Between nose and frame, between head and temples."""
_FRONT_MM = 12.0
"""Vertices this far behind the hinges or less may touch the face."""


def fit_temples(shape: GlassesShape, seed: int, head: RayScene, nose_top: FloatArray) -> GlassesBend:
    """Return the bend that spreads a frame's temples around a head that looks along +z, in mm.

    `seed` adds random bends: the bridge by up to 3 degrees, the halves against each other by up to 2. The
    frame will sit at `nose_top` (3,).
    """
    rng = np.random.default_rng([seed, 8])
    bend = GlassesBend(0.0, bridge_deg=rng.uniform(-3, 3), twist_deg=rng.uniform(-2, 2))
    straight = eyeglasses(shape=shape, bend=replace(bend, bridge_deg=0.0, twist_deg=0.0))
    placed = transform_points(seat(straight, head, nose_top), straight.vertices)
    hinge_z = straight.rest_keypoints[:, 2].max() - _FRONT_MM
    temple = straight.rest_vertices[:, 2] < hinge_z
    u = (hinge_z - straight.rest_vertices[temple, 2]) / (hinge_z - straight.rest_vertices[:, 2].min())
    side = np.sign(straight.rest_vertices[temple, 0])
    away = np.column_stack([side, np.zeros((len(side), 2))])
    hits = head.first_hit(placed[temple] + _FAR_MM * away, -away)
    lacking = _FAR_MM - hits.distance + _CLEARANCE_MM
    # Near the hinge no spread helps, so that the rest of the temple decides.
    reach = u**2 * (3 - u) / 2
    needed = np.where((hits.face >= 0) & (u > 0.4), lacking / np.maximum(reach, 1e-9), 0.0)
    spread = float(np.clip(needed.max(initial=0.0), 0.0, 16.0))
    return replace(bend, temple_spread_mm=spread + rng.uniform(0, 2))


def seat(glasses: SyntheticEyeglasses, head: RayScene, eyes: FloatArray) -> FloatArray:
    """Return rigid `world_from_glasses` (4, 4) of a frame that just touches a face with `eyes` (3,)."""
    # Lower rims lean towards the cheeks, and the frame hangs a little, as opticians fit them.
    start = compose(rotation_from_vector([np.deg2rad(3.0), 0, 0]), eyes + [0.0, -3.0, _FAR_MM])
    front = glasses.vertices[:, 2] > glasses.keypoints[:, 2].max() - _FRONT_MM
    hits = head.first_hit(transform_points(start, glasses.vertices[front]), np.array([0.0, 0, -1]))
    start[2, 3] -= float(hits.distance[hits.face >= 0].min()) - _CLEARANCE_MM
    return start


@dataclass(frozen=True)
class Wearer:
    """A person who wears glasses, in the face model's frame: mm, looking along +z."""

    glasses: SyntheticEyeglasses
    """In its own frame: `rest_vertices` known before the bend, `vertices` bent."""
    world_from_glasses: FloatArray
    """(4, 4) rigid."""
    sitter: Sitter
    """Who wears them."""
    head_vertices: FloatArray
    """(H, 3) of all that can hide the glasses."""
    head_faces: IntArray
    """(G, 3)."""
    cameras: FloatArray
    """(C, 3, 4)."""
    masks: BoolArray
    """(C, S, S) True where a view shows the glasses."""
    labels: FloatArray
    """(C, 20, 2) pixels; NaN where the head hides a key point or it is missing."""
    hidden: BoolArray
    """(C, V) vertices that the head hides; what the frame itself hides does not count."""

    @property
    def vertices(self) -> FloatArray:
        """(V, 3) the true frame in the world."""
        return transform_points(self.world_from_glasses, self.glasses.vertices)

    @property
    def keypoints(self) -> FloatArray:
        """(20, 3) the true key points in the world."""
        return self.vertices[self.glasses.keypoint_vertices]

    @property
    def seen(self) -> BoolArray:
        """(V,) vertices that the head hides from some views at most."""
        return np.asarray(~self.hidden.all(0))


def wearer(
    seed: int = 0,
    *,
    bend: GlassesBend | None = None,
    focal_px: float = 1800.0,
    picture_size: int = 1024,
    label_noise_px: float = 1.0,
    mask_noise_px: float = 1.0,
    outliers: int = 0,
    missing: int = 0,
    hair: bool = False,
) -> Wearer:
    """Return a random person with glasses on the nose.

    Parameters
    ----------
    seed : int
        Of the person, the frame, the noise.
    bend : GlassesBend, optional
        Otherwise temples are spread around the head and bridge and halves bent a little.
    focal_px : float
        Of the cameras.
    picture_size : int
        Height and width of the pictures in pixels.
    label_noise_px, mask_noise_px : float
        Standard deviations: of the labels along each axis, and of the smooth error of a mask's outline,
        correlated over some six pixels.
    outliers : int
        Labels a view that lie anywhere within 150 px.
    missing : int
        Key points without a label in any view.
    hair : bool
        Whether hair that may hide the temples' ends is there.
    """
    sitter = sit_down(seed, expression="neutral", model=default_model())
    head = compact(sitter.vertices, sitter.faces[hair | (sitter.part != BodyPart.HAIR)])
    scene, eyes = RayScene(*head), sitter.face.landmarks[36:48].mean(0)
    measures = GlassesShape.drawn(np.random.default_rng(seed))
    bend = bend or fit_temples(measures, seed, scene, eyes)
    glasses = eyeglasses(shape=measures, bend=bend)
    world_from_glasses = seat(glasses, scene, eyes)
    vertices = transform_points(world_from_glasses, glasses.vertices)
    # Cameras look from 600 mm away at a point between the lenses and the ears.
    target = np.array([0.0, vertices[:, 1].mean(), np.percentile(vertices[:, 2], 60)])
    yaw_elevation_deg = (-38.0, 8.0), (0.0, -8.0), (38.0, 8.0)  # positive yaw at the wearer's left
    cameras = np.array(
        [
            look_at(target + 600 * toward(*k), target, focal_px=focal_px, shape=(picture_size, picture_size))
            for k in yaw_elevation_deg
        ]
    )
    rng = np.random.default_rng([seed, 9])
    # Half a millimetre behind what a ray meets first is still the same surface.
    hidden = np.stack([scene.hidden(eye, vertices, 0.5) for eye in camera_centers(cameras)])
    both = RayScene(*join([(vertices, glasses.faces), head]))
    masks = np.stack(
        [
            _mask(camera, both, vertices, len(glasses.faces), picture_size, mask_noise_px, rng)
            for camera in cameras
        ]
    )
    labels = np.stack([project(camera, vertices[glasses.keypoint_vertices])[0] for camera in cameras])
    labels += rng.normal(0, label_noise_px, labels.shape)
    labels[hidden[:, glasses.keypoint_vertices]] = np.nan
    _mislabel(labels, missing, outliers, rng)
    labels[((labels < 0) | (labels > picture_size - 1)).any(2)] = np.nan
    return Wearer(glasses, world_from_glasses, sitter, *head, cameras, masks, labels, hidden)


def _mislabel(labels: FloatArray, missing: int, outliers: int, rng: np.random.Generator) -> None:
    """Leave key points out of labels (C, 20, 2) in all views, and move some others of each view far away."""
    labels[:, rng.choice(labels.shape[1], missing, replace=False)] = np.nan
    for view in labels:
        labelled = np.flatnonzero(finite_rows(view))
        wrong = rng.choice(labelled, min(outliers, len(labelled)), replace=False)
        view[wrong] += rng.uniform(-150, 150, (len(wrong), 2))


def _mask(
    camera: FloatArray,
    scene: RayScene,
    vertices: FloatArray,
    faces: int,
    size: int,
    noise_px: float,
    rng: np.random.Generator,
) -> BoolArray:
    """Return (S, S) where a camera sees the first `faces` of a scene, those of the frame at `vertices`.

    The frame takes a small part of the picture; noise moves its outline by some pixels.
    """
    mask = np.zeros((size, size), bool)
    margin = 2 + 6 * noise_px
    seen = project(camera, vertices)[0]
    low = np.clip(np.floor(seen.min(0) - margin), 0, size).astype(int)
    high = np.clip(np.ceil(seen.max(0) + margin) + 1, 0, size).astype(int)
    window = (high[1] - low[1], high[0] - low[0])
    if min(window) <= 0:
        return mask
    rays = pixel_directions(camera, pixel_grid(window) + low)
    first = scene.first_hit(np.broadcast_to(camera_centers(camera[None])[0], rays.shape), rays).face
    shown = ((first >= 0) & (first < faces)).reshape(window)
    if noise_px > 0 and shown.any():
        wander = gaussian_filter(rng.normal(size=shown.shape), 3.0, mode="wrap")
        wander *= noise_px / wander.std()
        inside = distance_transform_edt(shown) - distance_transform_edt(~shown)
        inside -= np.where(shown, 0.5, -0.5)
        shown = np.asarray(inside + wander > 0)
    mask[low[1] : high[1], low[0] : high[0]] = shown
    return mask
