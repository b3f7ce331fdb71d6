"""Pictures of a person lit by one flash at a time and by the room alone, with everything known of them."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.synthetic.camera import TARGET_MM, PortraitOptions, exposure_for, toward
from scan2albedo.synthetic.face_shape import Expression
from scan2albedo.synthetic.glossy_person import GlossyFace, GlossyPerson, SeenSurface
from scan2albedo.synthetic.sitter import sit_down

_SIDE_DEG = 60.0
_HIGH_FLASHES_DEG = ((-20.0, 25.0), (20.0, 25.0))
"""Azimuth and elevation of the flashes that stand where no camera takes pictures."""
_ROOM_LAMPS_DEG = ((-35.0, 50.0), (40.0, 35.0), (5.0, 70.0))
_ROOM_DISTANCE_MM = 3000.0
_ROOM_COLOR = np.array([1.0, 0.93, 0.82])
_LEAST_GAIN = 0.1


@dataclass(frozen=True)
class FlashCaptureOptions(PortraitOptions):
    """How the pictures are taken, beside `PortraitOptions`.

    Flashes are as far away as cameras, and fall off with the square of the distance to 1 at `distance_mm`.

    Raises `ValueError` when a value is outside its range.
    """

    views: int = 9
    flashes: int = 11
    """`views`, `flashes`: cameras on an arc of 120 degrees around the face, and flashes, which stand where
    the cameras do; two more stand above when there are more flashes than views."""
    gain_deviation: float = 0.0
    """Standard deviation of the flashes' strengths, their mean being 1."""
    room: float = 0.15
    """Strength of the room's light relative to a flash."""
    _: KW_ONLY
    levels: int = 2
    """Of subdivision of the mesh, as in `PortraitOptions`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._refuse_below_one("views", "flashes")
        self._refuse_negative("gain_deviation", "room")
        if self.flashes > self.views + len(_HIGH_FLASHES_DEG):
            raise ValueError(
                f"there are {self.flashes} flashes and {self.views} views, expected "
                f"{len(_HIGH_FLASHES_DEG)} flashes more than views at most"
            )


@dataclass(frozen=True)
class FlashCapture(GlossyFace):
    """J = views x flashes pairs of pictures of a `GlossyFace`, in the frame of the face, mm."""

    flash: NDArray[np.generic]
    """(J, S, S, 3) uint8, uint16 or float32: values with a flash in the room's light; flashes run fastest."""
    room: NDArray[np.generic]
    """(J, S, S, 3): in the room's light alone, one picture a view, repeated."""
    skin: BoolArray
    """(J, S, S): pixels that show the face, and not hair."""
    view: IntArray
    light: IntArray
    """`view`, `light`: (J,): numbers of each pair's camera and flash."""
    head_rotations: FloatArray
    head_translations: FloatArray
    """`head_rotations`, `head_translations`: (P, 3, 3), (P, 3): poses of the head before each
    camera, x_cam = R x + t; flash k stands where camera k does. Cameras after the first `views` took no
    pictures."""
    intrinsics: FloatArray
    """(3, 3)."""
    exposure: float
    """Light of value 1 is what radiance 1 / exposure makes: fits find `exposure` times the reflectance."""
    light_gain: FloatArray
    """(L,): strength of each flash."""
    options: FlashCaptureOptions
    """How the pictures were taken."""

    @property
    def light_positions(self) -> FloatArray:
        """(L, 3) where the flashes stand."""
        return _centers(self.head_rotations, self.head_translations)[: self.options.flashes]

    @property
    def cameras(self) -> FloatArray:
        """(J, 3, 4) projection matrices of the pictures."""
        poses = np.concatenate([self.head_rotations, self.head_translations[..., None]], axis=2)
        return np.asarray((self.intrinsics @ poses)[self.view])

    def __len__(self) -> int:
        return len(self.flash)


def flash_capture(
    seed: int = 0,
    *,
    expression: Expression = "neutral",
    options: FlashCaptureOptions = FlashCaptureOptions(),
    model: AnnotatedSurface | None = None,
) -> FlashCapture:
    """Return pictures of a random person with one flash at a time.

    Skin reflects as `VertexReflectance` describes; hair, clothes and the rest of the head hide the face and
    cast shadows, too. The radiance is not computed by `reflectance`, and rays are Open3D's.

    Parameters
    ----------
    seed : int
        Of the person and of the noise.
    expression : str
        As in `synthetic.face`.
    options : FlashCaptureOptions
    model : AnnotatedFaceModel, optional
        The default model when omitted; it needs landmarks.
    """
    sitter = sit_down(seed, expression=expression, model=model or default_model())
    person = GlossyPerson.of(sitter, hair=options.hair)
    rotations, translations, intrinsics = _head_poses(options)
    centers = _centers(rotations, translations)
    rng = np.random.default_rng([seed, 21])
    gain = np.maximum(1 + options.gain_deviation * rng.standard_normal(options.flashes), _LEAST_GAIN)
    gain /= gain.mean()
    flashes, rooms, skin, brightest = [], [], [], []
    for c in range(options.views):
        camera = intrinsics @ np.column_stack([rotations[c], translations[c]])
        seen = person.seen(camera, centers[c], options.picture_size)
        ambient = _room_light(person, seen, options.room)
        rooms.append(seen.picture(ambient))
        skin.append(seen.marked(seen.on_face))
        for strength, position in zip(gain, centers[: options.flashes], strict=True):
            flash = person.lit(seen, position, reference_distance_mm=options.distance_mm)
            radiance = ambient + strength * flash
            flashes.append(seen.picture(radiance))
            brightest.append(radiance[seen.on_face].max(1))
    exposure = exposure_for(np.concatenate(brightest), options.saturated_part)
    view = np.repeat(np.arange(options.views), options.flashes)
    return FlashCapture(
        **vars(GlossyFace.truth_of(person, options.levels)),
        flash=np.stack([options.stored(exposure * picture, rng) for picture in flashes]),
        room=np.stack([options.stored(exposure * picture, rng) for picture in rooms])[view],
        skin=np.stack(skin)[view],
        view=view,
        light=np.tile(np.arange(options.flashes), options.views),
        head_rotations=rotations,
        head_translations=translations,
        intrinsics=intrinsics,
        exposure=exposure,
        light_gain=gain,
        options=options,
    )


def _head_poses(options: FlashCaptureOptions) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rotations (P, 3, 3), translations (P, 3) and intrinsics (3, 3) of all places around the head."""
    sides = np.linspace(-_SIDE_DEG, _SIDE_DEG, options.views) if options.views > 1 else [0.0]
    places = [(float(azimuth), 0.0) for azimuth in sides]
    places += _HIGH_FLASHES_DEG[: max(options.flashes - options.views, 0)]
    cameras = [options.camera(*place) for place in places]
    focal, middle = options.focal_px, (options.picture_size - 1) / 2
    intrinsics = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
    poses = np.linalg.solve(intrinsics, np.stack(cameras))
    return poses[:, :, :3], poses[:, :, 3], intrinsics


def _centers(rotations: FloatArray, translations: FloatArray) -> FloatArray:
    return -np.einsum("cji,cj->ci", rotations, translations)


def _room_light(person: GlossyPerson, seen: SeenSurface, strength: float) -> FloatArray:
    """Return the radiance (N, 3) under three lamps and light from everywhere, half each."""
    lamps = [
        person.lit(seen, TARGET_MM + _ROOM_DISTANCE_MM * toward(*lamp)) / len(_ROOM_LAMPS_DEG)
        for lamp in _ROOM_LAMPS_DEG
    ]
    return strength * _ROOM_COLOR * (0.5 * sum(lamps) + 0.5 * seen.diffuse_linear / np.pi)
