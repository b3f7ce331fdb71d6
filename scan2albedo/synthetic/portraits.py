"""Pictures of a person: lit by one flash at a time, or from all around; with everything known about them."""

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import ArrayLike, BoolArray, FloatArray, IntArray, NDArray, on_grid
from scan2albedo.geometry.pinhole import camera_centers, project
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.synthetic.glossy_person import GlossyFace, GlossyPerson, SeenSurface
from scan2albedo.synthetic.renderer import TARGET_MM, Portrait, refuse_outside, toward
from scan2albedo.synthetic.textures import LOOKS

_LEAST_GAIN = 0.1


@dataclass(frozen=True)
class FlashCapture(GlossyFace):
    """J = views x flashes pairs of pictures of a `GlossyFace`, in the frame of the face, mm."""

    flash: NDArray
    """(J, S, S, 3) uint8, uint16 or float32: values with a flash in the room's light; flashes run fastest."""
    room: NDArray
    """(J, S, S, 3): in the room's light alone, one picture a view, repeated."""
    skin: BoolArray
    """(J, S, S): pixels that show the face, and not hair."""
    view: IntArray
    light: IntArray
    """`view`, `light`: (J,): numbers of each pair's camera and flash."""
    head_rotations: FloatArray
    head_translations: FloatArray
    """`head_rotations`, `head_translations`: (P, 3, 3), (P, 3): poses of the head before each camera, x_cam =
    R x + t; flash k stands where camera k does. Cameras after the first `views` took no pictures."""
    intrinsics: FloatArray
    """(3, 3)."""
    exposure: float
    """Light of value 1 is what radiance 1 / exposure makes: fits find `exposure` times the reflectance."""
    light_gain: FloatArray
    """(L,): strength of each flash."""
    portrait: Portrait
    """What took the pictures."""

    @property
    def light_positions(self) -> FloatArray:
        """(L, 3) where the flashes stand."""
        count = len(self.light_gain)
        return -np.einsum("cji,cj->ci", self.head_rotations[:count], self.head_translations[:count])

    @property
    def cameras(self) -> FloatArray:
        """(J, 3, 4) projection matrices of the pictures."""
        poses = np.concatenate([self.head_rotations, self.head_translations[..., None]], axis=2)
        return (self.intrinsics @ poses)[self.view]

    def __len__(self) -> int:
        return len(self.flash)


def flash_capture(
    seed: int = 0,
    *,
    views: int = 9,
    flashes: int = 11,
    gain_deviation: float = 0.0,
    room: float = 0.15,
    hair: bool = True,
    levels: int = 2,
    portrait: Portrait = Portrait(),
) -> FlashCapture:
    """Return pictures of a random person with one flash at a time.

    Skin reflects as `VertexReflectance` describes; hair, clothes and the rest of the head hide the face and
    cast shadows. Flashes are as far away as cameras, and fall off with the square of the distance to 1 at
    `portrait.distance_mm`. Raises `ValueError` when a value is outside its range.

    Parameters
    ----------
    seed : int
        Of the person and of the noise.
    views, flashes : int
        Cameras on an arc of 120 degrees around the face, and flashes, which stand where the cameras do; up to
        two more stand above when there are more flashes than views.
    gain_deviation : float
        Standard deviation of the flashes' strengths, their mean being 1.
    room : float
        Strength of the room's light relative to a flash.
    hair : bool
        Whether there is hair, which hides and shades the brow and is not in the mesh.
    levels : int
        Of subdivision of the mesh, 1 to 3: 1 is 3,663 vertices, 2 is 14,533.
    portrait : Portrait
    """
    refuse_outside(1, views=views, flashes=flashes)
    refuse_outside(0, gain_deviation=gain_deviation, room=room)
    if flashes > views + 2:
        raise ValueError(f"there are {flashes} flashes and {views} views, expected at most 2 flashes more")
    person = GlossyPerson.seated(seed, hair, levels)
    # Poses of the head before all places where a camera or a flash stands.
    places = [(float(side), 0.0) for side in (np.linspace(-60, 60, views) if views > 1 else [0])]
    # Where flashes stand and no camera takes pictures.
    places += [(-20.0, 25.0), (20.0, 25.0)][: max(flashes - views, 0)]
    focal, middle = portrait.focal_px, (portrait.picture_size - 1) / 2
    intrinsics = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
    cameras = np.stack([portrait.camera(*place) for place in places])
    poses, centers = np.linalg.solve(intrinsics, cameras), camera_centers(cameras)
    rng = np.random.default_rng([seed, 21])
    gain = np.maximum(1 + gain_deviation * rng.standard_normal(flashes), _LEAST_GAIN)
    gain /= gain.mean()
    pictures, rooms, skin, brightest = [], [], [], []
    for c in range(views):
        seen = person.seen(cameras[c], centers[c], portrait.picture_size)
        ambient = room * _in_room(person, seen)
        rooms.append(on_grid(seen.mask, ambient.astype(np.float32)))
        skin.append(on_grid(seen.mask, seen.on_face))
        for strength, position in zip(gain, centers[:flashes], strict=True):
            flash = person.radiance_under(seen, position, reference_distance_mm=portrait.distance_mm)
            radiance = ambient + strength * flash
            pictures.append(on_grid(seen.mask, radiance.astype(np.float32)))
            brightest.append(radiance[seen.on_face].max(1))
    exposure = portrait.exposure(np.concatenate(brightest))
    view = np.repeat(np.arange(views), flashes)
    return FlashCapture(
        **vars(GlossyFace.from_person(person, levels)),
        flash=np.stack([portrait.stored(exposure * picture, rng) for picture in pictures]),
        room=np.stack([portrait.stored(exposure * picture, rng) for picture in rooms])[view],
        skin=np.stack(skin)[view],
        view=view,
        light=np.tile(np.arange(flashes), views),
        head_rotations=poses[:, :, :3],
        head_translations=poses[:, :, 3],
        intrinsics=intrinsics,
        exposure=exposure,
        light_gain=gain,
        portrait=portrait,
    )


def _in_room(person: GlossyPerson, seen: SeenSurface) -> FloatArray:
    """Return the radiance (N, 3) under three lamps 3 m away and light from everywhere, half each."""
    places = (-35.0, 50.0), (40.0, 35.0), (5.0, 70.0)
    lamps = [person.radiance_under(seen, TARGET_MM + 3000 * toward(*place)) / 3 for place in places]
    return LOOKS["room"] * (sum(lamps) / 2 + seen.diffuse_linear / 2 / np.pi)


@dataclass(frozen=True)
class FacePhotograph(GlossyFace):
    """A picture of a `GlossyFace`; frame: the face model's, mm."""

    image: NDArray
    """(S, S, 3) uint8, uint16 or float32: the picture as stored."""
    skin: BoolArray
    """(S, S): pixels that show the face, and not hair."""
    camera: FloatArray
    """(3, 4): projection matrix."""
    landmarks_px: FloatArray
    """(68, 2): labelled landmarks, with noise; NaN where they are hidden."""
    exposure: float
    portrait: Portrait
    """`exposure`, `portrait`: as in `FlashCapture`."""


def face_photograph(
    seed: int,
    environment_linear: ArrayLike,
    *,
    azimuth_deg: float = 0.0,
    elevation_deg: float = 0.0,
    lights: int = 256,
    landmark_noise_px: float = 1.0,
    hair: bool = True,
    portrait: Portrait = Portrait(),
) -> FacePhotograph:
    """Return a picture of the person of `flash_capture(seed)` under an environment map.

    Raises `ValueError` when a value is outside its range, or the map has another shape or is not finite.

    Parameters
    ----------
    seed : int
        Of the person and of the noise.
    environment_linear : (H, W, 3) array_like of float
        Radiance; rows from +y down to -y, columns by azimuth from -pi to pi, from +z toward +x.
    azimuth_deg, elevation_deg : float
        Of the camera.
    lights : int
        Distant lights that stand for the environment, each with its shadows.
    landmark_noise_px : float
        Standard deviation of the labelled landmarks.
    hair, portrait
        As in `flash_capture`, with a mesh of level 1.
    """
    refuse_outside(1, lights=lights)
    refuse_outside(0, landmark_noise_px=landmark_noise_px)
    if not (np.isfinite(azimuth_deg) and abs(elevation_deg) < 90):
        raise ValueError(f"the camera at {azimuth_deg}, {elevation_deg} degrees is nowhere")
    around = DistantLights.from_environment(environment_linear, lights)
    person = GlossyPerson.seated(seed, hair, levels=1)
    camera = portrait.camera(azimuth_deg, elevation_deg)
    center = camera_centers(camera[None])[0]
    seen = person.seen(camera, center, portrait.picture_size)
    radiance = person.under(seen, around)
    exposure = portrait.exposure(radiance[seen.on_face].max(1))
    rng = np.random.default_rng([seed, 22])
    image = portrait.stored(on_grid(seen.mask, (exposure * radiance).astype(np.float32)), rng)
    landmarks = person.sitter.face.landmarks
    pixels, _ = project(camera, landmarks)
    # A landmark 3 mm behind the surface that a ray meets first is still seen.
    hidden = person.scene.hidden(center, landmarks, 3.0)
    noisy = pixels + rng.normal(0, landmark_noise_px, pixels.shape)
    return FacePhotograph(
        **vars(GlossyFace.from_person(person, levels=1)),
        image=image,
        skin=on_grid(seen.mask, seen.on_face),
        camera=camera,
        landmarks_px=np.where(hidden[:, None], np.nan, noisy),
        exposure=exposure,
        portrait=portrait,
    )
