"""Lenses put into a pair of glasses, seen by a camera: under distant lights, or in a photograph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.checks import checked_keypoints
from scan2albedo.eyeglasses.lenses.inserted_lenses import SIDES, InsertedLens, insert_lens, without_glass
from scan2albedo.eyeglasses.lenses.lens_rendering import (
    LensRelighting,
    LensRenderer,
    PixelRegion,
    Rendering,
    checked_image,
    pasted,
    without_dark,
)
from scan2albedo.eyeglasses.lenses.lens_scene import LensScene, Surface
from scan2albedo.eyeglasses.lenses.lens_shading import LensMaterial
from scan2albedo.eyeglasses.lenses.lit_scene import LitScene
from scan2albedo.eyeglasses.lenses.photographed_scene import PhotographedScene
from scan2albedo.eyeglasses.lenses.traced_rays import Illumination, SceneColors
from scan2albedo.geometry.pinhole import normalized_cameras
from scan2albedo.lighting.environment import DistantLights, LightSpread

_NO_ENVIRONMENT = "no environment is given: lenses mirror surfaces only, and black"

Lenses = LensMaterial | tuple[LensMaterial | None, LensMaterial | None]

_FRINGE_PX = 1
"""Pixels around the frame, and of the background around surfaces, that a photograph's colours are not taken
from: they may hold some of both."""
_SEAT_MM = 0.3
"""How far lenses reach into their rims: outlines are exact to 0.2 mm, and no light shall pass between."""
_SHADOW_OFFSET_MM = 0.2
"""Shadow rays start this far off the surface."""


@dataclass(frozen=True)
class LensPictureOptions:
    """Settings of `insert_lenses`."""

    supersampling: int = 3
    """n x n rays for pixels on edges; one for all others."""
    light_count: int = 256
    """Distant lights that stand for an environment; time grows with them, and edges of shadows get softer."""
    light_spread: LightSpread = "important"
    """Whether these lights lie where the environment is bright, so that a quarter of them gives half the
    error, or evenly, so that pictures under two environments add up, as `relightable` ones must."""
    background: Literal["environment", "black"] = "environment"
    """What rays see that miss all surfaces. In a photograph it is always the photograph's own background."""
    hidden: Literal["nearest", "albedo"] = "nearest"
    """Colour of points that the photograph does not show: of the nearest point of the same surface that it
    shows, or the surface's albedo in the photograph's brightness."""
    shadows: Literal["shared", "every pixel"] = "shared"
    """Whether a pixel takes over what four neighbours on the same smooth surface agree on, which may lose
    shadows less than two pixels wide, or shoots rays of its own."""
    relightable: bool = False
    """Whether the picture keeps what `LensPicture.under` needs: some 150 bytes a pixel, and one a light.
    Lights are then spread evenly."""

    def __post_init__(self) -> None:
        for name in ("supersampling", "light_count"):
            if (count := getattr(self, name)) < 1:
                raise ValueError(f"{name} must be 1 or more, got {count}")
        choices = {
            "hidden": ("nearest", "albedo"),
            "shadows": ("shared", "every pixel"),
            "background": ("environment", "black"),
            "light_spread": get_args(LightSpread),
        }
        for name, known in choices.items():
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"{name} must be {known[0]!r} or {known[1]!r}, got {value!r}")


@dataclass(frozen=True)
class LensPicture:
    """A picture with lenses in it."""

    image_linear: FloatArray
    """(H, W, 3)."""
    without_lenses_linear: FloatArray
    """(H, W, 3): the photograph itself, or the scene with empty rims."""
    lens: NDArray[np.int8]
    """(H, W) the lens that a pixel's centre sees first: 0 the wearer's left, 1 the right, -1 none."""
    unknown: BoolArray
    """(H, W) True where a lens shows what the photograph does not, and the colour is a guess."""
    lenses: tuple[InsertedLens, ...]
    """With their rims and meshes."""
    notes: tuple[str, ...]
    """What was left out or filled in, a sentence each."""
    relighting: LensRelighting | None = field(default=None, repr=False)
    """What `under` needs; there with `LensPictureOptions.relightable`."""

    def under(
        self, environment_linear: ArrayLike | None = None, *, irradiance_linear: ArrayLike | None = None
    ) -> LensPicture:
        """Return the picture in another light, as the sum over lights k of w_k I_k (Li et al., section 6.3).

        It is what `insert_lenses` gives for the same lights, evenly spread, without a new ray. Raises
        EyeglassesError when the picture was not made with `LensPictureOptions(relightable=True)`, or the
        environment is not finite; ValueError when neither light is given, or shapes do not fit.

        Parameters
        ----------
        environment_linear : (H, W, 3) array_like of float, optional
            Lights the scene, unless the irradiance is given, stands behind it, and is what lenses mirror; of
            a photograph only the mirror images change. Black when omitted.
        irradiance_linear : (K, 3) or (K,) array_like of float, optional
            Of the distant lights the picture was made with, in their order.
        """
        if self.relighting is None:
            raise EyeglassesError(
                "this picture has kept one light only; make it with LensPictureOptions(relightable=True)"
            )
        around = None if environment_linear is None else checked_image("environment", environment_linear)
        strength = None if irradiance_linear is None else np.asarray(irradiance_linear, np.float64)
        colors = self.relighting.colors(self.relighting.light(around, strength))
        kept = tuple(note for note in self.notes if note != _NO_ENVIRONMENT)
        notes = kept + _mirror_notes(self.lenses, around)
        return replace(self, image_linear=colors.shaded, without_lenses_linear=colors.bare, notes=notes)


def insert_lenses(
    frame: Surface,
    keypoints: ArrayLike,
    lenses: Lenses,
    *,
    surfaces: Sequence[Surface],
    camera: ArrayLike,
    shape: tuple[int, int] | None = None,
    picture_linear: ArrayLike | None = None,
    environment_linear: ArrayLike | None = None,
    lights: DistantLights | None = None,
    lens_centers: ArrayLike | None = None,
    options: LensPictureOptions = LensPictureOptions(),
) -> LensPicture:
    """Return a picture of a pair of glasses with lenses put in.

    Each ray that meets a lens before anything else is bent as by a thin lens and goes on, through the other
    lens too, to the scene behind; its mirror image leaves on the sphere of the lens's front. The colour is

        (1 - alpha - beta) behind + alpha tint + beta mirrored,

    as in the supplement of Li et al., section 6.3 and equations S11 to S15.

    With `shape` the scene is drawn under distant lights: those given, or those that stand for the
    environment. With `picture_linear` colours come from a photograph of the same scene with empty rims: where
    a bent ray meets a surface, that point is looked up in the photograph.

    Parameters
    ----------
    frame : Surface
        In its pose on the face. Glass of its own is left out where a lens goes, unless it is of one piece
        with the rim; `notes` say so. All lengths are mm: dioptres mean nothing in other units.
    keypoints : (20, 3) array_like of float
        Of the frame in the same pose, in the order of `KEY_POINT_NAMES`. Those of each rim that gets a lens
        are needed; others may be NaN.
    lenses : LensMaterial, or (left, right) of LensMaterial or None
        For both eyes, or for each of the wearer's; None leaves a rim empty.
    surfaces : sequence of Surface
        What lenses show: face, head.
    camera : (3, 4) array_like of float
        Projects mm to pixels (column, row), centres of pixels at integers.
    shape : (H, W), optional
        Of the picture to draw; instead of `picture_linear`.
    picture_linear : (H, W, 3) array_like of float, optional
        A photograph by this camera, linear.
    environment_linear : (H, W, 3) array_like of float, optional
        Radiance as in `environment_radiance`. Lights the scene unless `lights` are given, stands behind it,
        and is what lenses mirror; without it they mirror surfaces only, and black.
    lights : DistantLights, optional
        Only with `shape`.
    lens_centers : (2, 3) array_like of float, optional
        Optical centres of the left and the right lens, moved into their planes; otherwise the centroids of
        their outlines.
    options : LensPictureOptions

    Raises
    ------
    EyeglassesError
        When a rim's key points are missing or no lens fits into it (the message names which), a surface or
        the picture is not finite, or sizes are no millimetres.
    ValueError
        When shapes do not fit together, or it is not clear what to draw: both or none of `shape` and
        `picture_linear`, no light, lights for a photograph.

    Notes
    -----
    - Linear in the light: under lights that are given or spread evenly, pictures under two environments add
      up to the picture under their sum. A painted tint is a matte surface in the same light; in a photograph
      it is taken as it is.
    - In drawn scenes surfaces and lenses cast shadows (a lens according to its shares, without bending
      light); in photographs none do, whose shadows stay.
    - What lenses mirror is seen past all lenses. Light does not bounce otherwise.
    - A photograph's background counts as far away.
    - Shadows shared between pixels (`LensPictureOptions.shadows`) take some 40 % of the shadow rays; colours
      are off by 1e-5 of the mean under 64 lights, by a shadow's edge in 1 of 4000 pixels under one; where a
      pixel is 0.5 to 1 mm wide, by 0.3 to 0.7 % rms.
    - An environment's lights have no size: many of them, where it is bright, make shadows soft. 256 are 1 %
      rms off a reference of 8,192 directions, 64 are 2.5 %, 64 evenly spread ones 11 to 12 %.
    - Cost: a ray for each pixel, n x n of them on edges, and shadow rays in proportion to the lights. 1024 x
      1024 pixels, a head of 300,000 faces: 1.9 s of CPU time under 8 lights, 3.7 s under 64, then 0.2 s in
      any other light (`LensPicture.under`).

    Examples
    --------
    >>> from scan2albedo.geometry.pinhole import look_at
    >>> from scan2albedo.synthetic import eyeglasses
    >>> glasses = eyeglasses(seed=1)
    >>> wall = Surface([[-300, -300, -30], [300, -300, -30], [0, 500, -30]], [[0, 1, 2]])
    >>> picture = insert_lenses(
    ...     Surface(glasses.vertices, glasses.faces),
    ...     glasses.keypoints,
    ...     (LensMaterial(dioptres=-4.0), LensMaterial(dioptres=-2.5)),
    ...     surfaces=[wall],
    ...     camera=look_at([0, 0, 600], [0, 0, 0], focal_px=200, shape=(48, 64)),
    ...     shape=(48, 64),
    ...     environment_linear=np.ones((8, 16, 3)),
    ... )
    >>> picture.image_linear.shape, np.unique(picture.lens).tolist(), picture.notes
    ((48, 64, 3), [-1, 0, 1], ())
    """
    matrix = normalized_cameras(np.asarray(camera, np.float64)[None])[0]
    photograph = None if picture_linear is None else checked_image("picture_linear", picture_linear)
    size = _picture_size(shape, photograph)
    around = None if environment_linear is None else checked_image("environment_linear", environment_linear)
    lights = _chosen_lights(photograph, around, lights, options)
    toward = np.zeros((0, 3)) if lights is None else np.asarray(lights.directions)
    irradiance = np.zeros((0, 3)) if lights is None else np.asarray(lights.irradiance_linear)
    placed = _placed(frame, keypoints, lenses, lens_centers)
    bare = without_glass(frame, placed, np.asarray(keypoints, np.float64))
    scene = LensScene(bare.surface, surfaces)
    region = PixelRegion.of_lenses(placed, matrix, size)
    colors: SceneColors
    if photograph is None:
        colors = _lit_scene(scene, placed, toward, options)
        empty, window = np.zeros((*size, 3)), PixelRegion(0, 0, size[1], size[0])
    else:
        colors = _photographed_scene(scene, photograph, matrix, region, options)
        # Outside the region a photograph stays as it is.
        empty, window = photograph, region
    renderer, light = LensRenderer(scene, placed, colors, matrix, region), Illumination(irradiance, around)
    rendering = renderer.picture(window, options.supersampling, light, keep=options.relightable)
    notes = bare.notes + _notes(placed, rendering) + _mirror_notes(placed, around)
    return _lens_picture(rendering, window, empty, toward, placed, notes)


def _picture_size(shape: tuple[int, int] | None, photograph: FloatArray | None) -> tuple[int, int]:
    if (shape is None) == (photograph is None):
        raise ValueError("give either shape, to draw the scene, or picture_linear, a photograph of it")
    height, width = photograph.shape[:2] if photograph is not None else shape or (0, 0)
    if height < 1 or width < 1:
        raise ValueError(f"a picture needs pixels, got a shape of ({height}, {width})")
    return int(height), int(width)


def _chosen_lights(
    photograph: FloatArray | None,
    around: FloatArray | None,
    lights: DistantLights | None,
    options: LensPictureOptions,
) -> DistantLights | None:
    """Return the lights to draw under, given or standing for the environment; None for a photograph."""
    if photograph is not None:
        if lights is not None:
            raise ValueError("a photograph has its own light; leave lights out, or give shape instead")
        return None
    if lights is None and around is not None:
        lights = _lights_of(around, options)
    if lights is None:
        raise ValueError("a scene without light is black; give environment_linear or lights")
    return lights if options.relightable else without_dark(lights)


def _lights_of(environment: FloatArray, options: LensPictureOptions) -> DistantLights:
    """Return the lights that stand for an environment (H, W, 3)."""
    spread: LightSpread = "even" if options.relightable else options.light_spread
    return DistantLights.from_environment(environment, options.light_count, spread)


def _placed(
    frame: Surface,
    keypoints: ArrayLike,
    lenses: Lenses,
    centers: ArrayLike | None,
) -> tuple[InsertedLens, ...]:
    """Return the lenses in their rims."""
    marks = checked_keypoints("keypoints", keypoints)
    materials = (lenses, lenses) if isinstance(lenses, LensMaterial) else tuple(lenses)
    if len(materials) != 2:
        raise ValueError(f"lenses must be one material or (left, right), got {len(materials)}")
    middles = None if centers is None else np.asarray(centers, np.float64)
    if middles is not None and middles.shape != (2, 3):
        raise ValueError(f"lens_centers must have shape (2, 3), got {middles.shape}")
    return tuple(
        insert_lens(
            np.asarray(frame.vertices),
            np.asarray(frame.faces),
            marks,
            side,
            material,
            center=None if middles is None else middles[side],
            seat_mm=_SEAT_MM,
        )
        for side, material in enumerate(materials)
        if material is not None
    )


def _lit_scene(
    scene: LensScene, lenses: tuple[InsertedLens, ...], toward: FloatArray, options: LensPictureOptions
) -> LitScene:
    return LitScene(
        scene,
        lenses,
        toward,
        background=options.background == "environment",
        offset_mm=_SHADOW_OFFSET_MM,
        every_pixel=options.shadows == "every pixel",
    )


def _photographed_scene(
    scene: LensScene,
    photograph: FloatArray,
    camera: FloatArray,
    region: PixelRegion,
    options: LensPictureOptions,
) -> PhotographedScene:
    return PhotographedScene(
        scene,
        photograph,
        camera,
        nearest=options.hidden == "nearest",
        fringe_px=_FRINGE_PX,
        region=region.slices,
    )


def _lens_picture(
    rendering: Rendering,
    window: PixelRegion,
    empty: FloatArray,
    toward: FloatArray,
    lenses: tuple[InsertedLens, ...],
    notes: tuple[str, ...],
) -> LensPicture:
    """Return the picture with the pixels of the window; outside it is `empty` (H, W, 3)."""
    size, traced = empty.shape[:2], rendering.traced
    return LensPicture(
        pasted(empty, window, rendering.colors.shaded),
        pasted(empty, window, rendering.colors.bare),
        pasted(np.full(size, -1, np.int8), window, rendering.lens),
        pasted(np.zeros(size, bool), window, rendering.unknown),
        lenses,
        notes,
        None if traced is None else LensRelighting(traced, window, empty, toward),
    )


def _mirror_notes(lenses: tuple[InsertedLens, ...], environment: FloatArray | None) -> tuple[str, ...]:
    mirrors = any(lens.material.beta > 0 or lens.material.fresnel for lens in lenses)
    return (_NO_ENVIRONMENT,) if environment is None and mirrors else ()


def _notes(lenses: tuple[InsertedLens, ...], rendering: Rendering) -> tuple[str, ...]:
    notes = []
    for lens in lenses:
        rim = lens.rim
        if rim.gaps != "none":
            source = "its key points" if rim.gaps == "subdivided" else "the rim on both sides"
            filled = int((~rim.measured).sum())
            share = f"{filled} of {len(rim.points)} points"
            notes.append(f"the {lens.name}: {share} of its rim come from {source}")
        if not (rendering.lens == lens.side).any():
            notes.append(f"the {lens.name}: no pixel sees it")
    if rendering.glancing:
        notes.append(f"{rendering.glancing} rays run along a lens and pass it as if it were not there")
    if rendering.unknown.any():
        notes.append(
            f"{int(rendering.unknown.sum())} pixels show in a lens what the photograph hides; "
            "their colours are guesses"
        )
    if not lenses:
        notes.append(f"no lens is given, neither {SIDES[0]} nor {SIDES[1]}")
    return tuple(notes)
