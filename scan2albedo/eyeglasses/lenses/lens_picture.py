"""Lenses put into a pair of glasses, seen by a camera: under distant lights, or in a photograph."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    FloatArray,
    GridShape,
    IntArray,
    NDArray,
    Texts,
    Values,
    checked_array,
    norms,
    rms,
)
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import checked_keypoints
from scan2albedo.eyeglasses.lenses import inserted_lenses as inserted
from scan2albedo.eyeglasses.lenses.optics import LensMaterial
from scan2albedo.eyeglasses.lenses.scene_colors import LitScene, PhotographedScene, SceneColors
from scan2albedo.eyeglasses.lenses.scenes import LensScene, Surface
from scan2albedo.geometry import pinhole
from scan2albedo.geometry.rays import blocks
from scan2albedo.lighting.environment import DistantLights

Lenses = LensMaterial | tuple[LensMaterial | None, LensMaterial | None]
Window = tuple[slice, slice]

_SEAT_MM = 0.3
"""How far lenses reach into their rims: outlines are exact to 0.2 mm, and no light shall pass between."""


@dataclass(frozen=True)
class LensPictureOptions:
    """Settings of `insert_lenses`."""

    supersampling: int = 3
    """n x n rays for pixels on edges; one for all others."""
    light_count: int = 256
    """Distant lights that stand for an environment; time grows with them, and shadows get softer."""

    def __post_init__(self) -> None:
        for name in ("supersampling", "light_count"):
            if (count := getattr(self, name)) < 1:
                raise ValueError(f"{name} must be 1 or more, got {count}")


@dataclass(frozen=True)
class LensPicture:
    """A picture with lenses in it, `image_linear` (H, W, 3)."""

    image_linear: FloatArray
    without_lenses_linear: FloatArray
    """(H, W, 3): the photograph itself, or the scene with empty rims."""
    lens: NDArray[np.int8]
    """(H, W) the lens that a pixel's centre sees first: 0 the wearer's left, 1 the right, -1 none."""
    unknown: BoolArray
    """(H, W) True where a lens shows what the photograph does not, and the colour is a guess."""
    lenses: tuple[inserted.InsertedLens, ...]
    """With their rims and meshes."""
    notes: Texts
    """What was left out or filled in, a sentence each."""


def insert_lenses(
    frame: Surface,
    keypoints: ArrayLike,
    lenses: Lenses,
    *,
    surfaces: Sequence[Surface],
    camera: ArrayLike,
    shape: GridShape | None = None,
    picture_linear: ArrayLike | None = None,
    environment_linear: ArrayLike | None = None,
    lights: DistantLights | None = None,
    lens_centers: ArrayLike | None = None,
    rim_masks: Sequence[tuple[ArrayLike, ArrayLike]] = (),
    options: LensPictureOptions = LensPictureOptions(),
) -> LensPicture:
    """Return a picture of a pair of glasses with lenses put in.

    A ray that meets a lens first is bent as by a thin lens and goes on, through the other lens too, to the
    scene behind; its mirror image leaves on the sphere of the lens's front. The colour is

        (1 - alpha - beta) behind + alpha tint + beta mirrored,

    as in the supplement of Li et al., section 6.3 and equations S11 to S15.

    With `shape` the scene is drawn under distant lights. With `picture_linear` colours come from a photograph
    of it with empty rims: where a bent ray meets a surface, that point is looked up in it. Raises
    EyeglassesError when no lens fits into a rim, numbers are not finite, or sizes are not millimetres;
    ValueError when shapes do not fit together, or it is not clear what to draw under which light.

    Parameters
    ----------
    frame : Surface
        In its pose on the face, in mm. Glass of its own is left out, unless of one piece with the rim.
    keypoints : (20, 3) array_like of float
        Of the frame, as in `KEY_POINT_NAMES`; NaN but for those of each rim that gets a lens.
    lenses : LensMaterial, or (left, right) of LensMaterial or None
        For both eyes, or for each of the wearer's; None leaves a rim empty.
    surfaces : sequence of Surface
        What lenses show: face, head.
    camera : (3, 4) array_like of float
        Projects mm to pixels (column, row), centres of pixels at integers.
    shape, picture_linear : (H, W), or (H, W, 3) array_like of float
        Of the picture to draw, or a linear photograph by this camera; one of them.
    environment_linear : (H, W, 3) array_like of float, optional
        Radiance as in `environment_radiance`: lights a drawn scene unless `lights` are given, stands behind
        it, and is what lenses mirror.
    lights : DistantLights, optional
        Only with `shape`.
    lens_centers : (2, 3) array_like of float, optional
        Optical centres, left and right, moved into the lens planes; otherwise the outlines' centroids.
    rim_masks : sequence of ((3, 4), (H, W)) array_like
        Cameras and masks of the frame without lenses, by which `refine_lens_rim` refines the outlines.
    options : LensPictureOptions

    Notes
    -----
    A painted tint is a matte surface in the same light; in a photograph it is taken as it is. In drawn scenes
    surfaces and lenses cast shadows; in photographs none do, whose background counts as far away. Light does
    not bounce otherwise. 256 lights are 1 % rms off 8,192 directions, 64 are 2.5 %; cost grows with them.
    """
    matrix = pinhole.normalized_cameras(np.asarray(camera, float)[None])[0]
    photograph, around = (
        None if image is None else checked_array(image, ("H", "W", 3), name, finite=EyeglassesError)
        for name, image in (("picture_linear", picture_linear), ("environment_linear", environment_linear))
    )
    if (shape is None) == (photograph is None):
        raise ValueError("give either shape, to draw the scene, or picture_linear, a photograph of it")
    height, width = photograph.shape[:2] if photograph is not None else shape or (0, 0)
    if height < 1 or width < 1:
        raise ValueError(f"a picture needs pixels, got a shape of ({height}, {width})")
    if photograph is not None and lights is not None:
        raise ValueError("a photograph has its own light; leave lights out, or give shape instead")
    if photograph is None and lights is None and around is None:
        raise ValueError("a scene without light is black; give environment_linear or lights")
    marks = checked_keypoints("keypoints", keypoints)
    materials = (lenses, lenses) if isinstance(lenses, LensMaterial) else tuple(lenses)
    if len(materials) != 2:
        raise ValueError(f"lenses must be one material or (left, right), got {len(materials)}")
    middles: list[FloatArray | None] = [None, None]
    if lens_centers is not None:
        middles = list(checked_array(lens_centers, (2, 3), "lens_centers", finite=EyeglassesError))
    frame_parts = frame.vertices, frame.faces, marks
    sides = [(side, material) for side, material in enumerate(materials) if material is not None]
    seat: Values = {"seat_mm": _SEAT_MM, "rim_masks": rim_masks}
    placed = tuple(inserted.insert_lens(*frame_parts, k, own, center=middles[k], **seat) for k, own in sides)
    bare, glass_notes = inserted.without_glass(frame, placed, marks)
    scene, notes = LensScene(bare, surfaces), list(glass_notes)
    region = _lens_region(matrix, placed, (height, width))
    colors: SceneColors
    if photograph is not None:
        # Outside the lenses a photograph stays as it is.
        empty, window = photograph, region
        colors = PhotographedScene(scene, photograph, matrix, region=region, environment=around)
    else:
        if lights is None:
            assert around is not None
            lights = DistantLights.from_environment(around, options.light_count, "important")
        empty, window = np.zeros((height, width, 3)), (slice(0, height), slice(0, width))
        colors = LitScene(scene, placed, lights, around)
    made = _View(scene, placed, colors, matrix, region).pixels(window, options.supersampling)
    image, without = empty.copy(), empty.copy()
    unknown, seen = np.zeros((height, width), bool), np.full((height, width), -1, np.int8)
    wholes: tuple[NDArray, ...] = (image, without, unknown, seen)
    for whole, values in zip(wholes, (made.shaded, made.bare, made.unknown, made.lens), strict=True):
        whole[window] = values.reshape(whole[window].shape)
    for lens in placed:
        notes += _lens_notes(lens, len(rim_masks) > 0, (seen == lens.side).any())
    if made.glancing:
        notes.append(f"{made.glancing} rays run along a lens and pass it as if it were not there")
    if lost := unknown.sum():
        notes.append(f"{lost} pixels show in a lens what the photograph hides; their colours are guesses")
    if not placed:
        notes.append(f"no lens is given, neither {inserted.SIDES[0]} nor {inserted.SIDES[1]}")
    if around is None and any(lens.material.beta > 0 or lens.material.fresnel for lens in placed):
        notes.append("no environment is given: lenses mirror surfaces only, and black")
    return LensPicture(image, without, seen, unknown, placed, tuple(notes))


def _lens_region(camera: FloatArray, lenses: Sequence[inserted.InsertedLens], shape: GridShape) -> Window:
    """Return rows and columns of the pixels that may see a lens, with one to spare around them."""
    size = np.array(shape[::-1], float)
    low, high = np.zeros(2), np.zeros(2)
    if lenses:
        pixels, depth = pinhole.project(camera, np.concatenate([lens.vertices for lens in lenses]))
        if (depth > 0).all():
            low, high = np.floor(pixels.min(0)) - 1, np.ceil(pixels.max(0)) + 2
        elif (depth > 0).any():
            high = size
    (left, top), (right, bottom) = np.clip([low, high], 0, size).astype(int).tolist()
    return slice(top, bottom), slice(left, right)


def _lens_notes(lens: inserted.InsertedLens, masked: bool, seen: bool) -> list[str]:
    """Return where a lens's rim comes from, what masks that could refine it did, and if it is not seen."""
    notes, rim = [], lens.rim
    if rim.gaps != "none":
        source = "its key points" if rim.gaps == "subdivided" else "the rim on both sides"
        notes.append(f"{(~rim.measured).sum()} of {len(rim.points)} points of its rim come from {source}")
    if rim.deviation is not None:
        off = rms(rim.deviation)
        notes.append(f"masks refine its outline, to {off:.2f} mm (standard deviation)")
    elif masked:
        notes.append("no mask shows half of its outline and agrees with the rim, which stays")
    if not seen:
        notes.append("no pixel sees it")
    return [f"the {lens.name}: {note}" for note in notes]


@dataclass(frozen=True)
class _SeenRays:
    """What N rays see: colours without lenses and with them, where these are guesses, the first lens (or -1).

    `surface` (N,) is the number of the surface at the end, `distance` (N,) mm how far it is.
    """

    bare: FloatArray
    shaded: FloatArray
    unknown: BoolArray
    lens: IntArray
    surface: IntArray
    distance: FloatArray
    glancing: int


@dataclass(frozen=True)
class _View:
    """A normalised camera (3, 4) before a scene with lenses, which only pixels of a region may see."""

    scene: LensScene
    lenses: Sequence[inserted.InsertedLens]
    colors: SceneColors
    camera: FloatArray
    region: Window

    def pixels(self, window: Window, supersampling: int) -> _SeenRays:
        """Return the pixels of a window; colours of those on edges are means of n x n rays."""
        rows, columns = window
        shape = rows.stop - rows.start, columns.stop - columns.start
        pixels = pinhole.pixel_grid(shape) + [columns.start, rows.start]
        once = self._rays(pixels)
        # Edges: pixels whose ray differs from a neighbour's in lens, surface or distance.
        kind = (once.lens + (once.surface + 1) * 4).reshape(shape)
        distance = np.where(np.isfinite(once.distance), once.distance, 0.0).reshape(shape)
        edges = np.zeros(shape, bool)
        for axis in (0, 1):
            across, kinds, mark = (np.moveaxis(a, axis, 0) for a in (distance, kind, edges))
            # A step in depth of eight pixels' sizes there.
            least = 8.0 * (np.minimum(across[1:], across[:-1]) / pinhole.focal_px(self.camera))
            step = (kinds[1:] != kinds[:-1]) | (np.abs(across[1:] - across[:-1]) > least)
            mark[1:] |= step
            mark[:-1] |= step
        edge = np.flatnonzero(edges)
        if supersampling > 1 and len(edge):
            steps = (np.arange(supersampling) + 0.5) / supersampling - 0.5
            offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
            fine = self._rays((pixels[edge, None] + offsets).reshape(-1, 2))
            parts, through = (c.reshape(len(edge), -1, 3) for c in (fine.bare, fine.shaded))
            # Means of equal numbers may differ from them in the last digit; differences of 0 stay 0.
            once.bare[edge] = parts[:, 0] + (parts - parts[:, :1]).mean(1)
            once.shaded[edge] = np.maximum(once.bare[edge] + (through - parts).mean(1), 0.0)
            once.unknown[edge] = fine.unknown.reshape(len(edge), -1).any(1)
        return once

    def _rays(self, pixels: FloatArray) -> _SeenRays:
        # A bound on memory.
        if len(bands := blocks(len(pixels), 2**15)) > 1:
            parts = [self._rays(pixels[band]) for band in bands]
            names = ("bare", "shaded", "unknown", "lens", "surface", "distance")
            joined: Values = {n: np.concatenate([getattr(part, n) for part in parts]) for n in names}
            return _SeenRays(**joined, glancing=sum(part.glancing for part in parts))
        scene, center = self.scene, pinhole.camera_centers(self.camera)
        straight = scene.rays(center, pinhole.pixel_directions(self.camera, pixels), pixels)
        rows, columns = self.region
        cell = np.floor(pixels + 0.5)
        inside = (cell >= [columns.start, rows.start]) & (cell < [columns.stop, rows.stop])
        near = np.flatnonzero(inside.all(1))
        paths = inserted.trace_lenses(scene, self.lenses, straight.chosen(near))
        bent = np.flatnonzero(paths.bent)
        reflecting = [np.flatnonzero(crossings.mirror_share.any(1)) for crossings in paths.crossings]
        mirrored = [
            scene.rays(c.position[which], c.mirrored[which], pixels[near[c.ray[which]]])
            for c, which in zip(paths.crossings, reflecting, strict=True)
        ]
        colors, through, *reflections = self.colors.look(straight, paths.rays.chosen(bent), mirrored)
        shaded, unknown = colors.shaded.copy(), colors.unknown.copy()
        behind = shaded[near]
        behind[bent] = through.shaded
        unknown[near[bent]] |= through.unknown
        shaded[near] = paths.share * behind
        for crossings, which, reflection in zip(paths.crossings, reflecting, reflections, strict=True):
            ray, tint = near[crossings.ray], np.asarray(crossings.lens.material.tint_linear)
            if crossings.tint_share.any() and tint.any():
                normal = crossings.lens.rim.normal
                toward_viewer = -np.sign(crossings.direction @ normal)[:, None] * normal
                plate = self.colors.matte(crossings.position, toward_viewer, tint)
                shaded[ray] += crossings.tint_share * plate
            shaded[ray[which]] += crossings.mirror_share[which] * reflection.shaded
            unknown[ray[which]] |= reflection.unknown
        lens, face, distance = np.full(len(pixels), -1), straight.hits.face.copy(), straight.hits.distance
        lens[near], face[near] = paths.first, paths.rays.hits.face
        distance = distance.copy()
        distance[near] = norms(paths.rays.ends - center)
        surface = np.where(face >= 0, scene.surface_of_face[face], -1)
        return _SeenRays(colors.bare.copy(), shaded, unknown, lens, surface, distance, paths.glancing)
