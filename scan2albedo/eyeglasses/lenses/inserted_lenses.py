"""Lenses that fill the rims of a frame, the glass that makes room for them, and rays on their way through."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from scan2albedo.core.arrays import (
    SMALLEST,
    ArrayLike,
    BoolArray,
    FloatArray,
    IntArray,
    Texts,
    all_finite,
    checked_array,
    dots,
    norms,
)
from scan2albedo.errors import EyeglassesError, errors_of
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.lenses import rims
from scan2albedo.eyeglasses.lenses.optics import LensMaterial, ThinLens, mirror_on_sphere, refract
from scan2albedo.eyeglasses.lenses.scenes import LensScene, SceneRays, Surface
from scan2albedo.eyeglasses.mean_keypoints import RIMS, SIDES, own_axes
from scan2albedo.geometry.mesh import face_cross_products
from scan2albedo.geometry.rays import RayCaster

_GLANCING = 1e-3
"""Sine of the angle to the lens plane, and mm from the start to the lens, below which a ray passes none."""


@dataclass(frozen=True)
class InsertedLens:
    """A lens of a `material` in its `rim`, on `side` 0, the wearer's left, or 1; mm in the world's frame.

    `vertices` (R + 1, 3), the centre first, rim points moved into their seat, and `faces` (R, 3) are its
    mesh, which `caster` casts rays at. `optics` is in the plane nearest to the rim, towards the viewer.
    """

    side: int
    material: LensMaterial
    rim: rims.LensRim
    vertices: FloatArray
    faces: IntArray
    optics: ThinLens
    caster: RayCaster

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
    rim_masks: Sequence[tuple[ArrayLike, ArrayLike]] = (),
) -> InsertedLens:
    """Return the lens that fills one rim of a frame, whose key points are needed; lengths in mm.

    The optical `center` (3,) is moved into the lens plane along its normal; the outline's centroid when
    omitted. Points of the outline that were measured move `seat_mm` outward, into the rim. `rim_masks` are
    cameras and masks for `refine_lens_rim`. Raises EyeglassesError, naming the lens, when key points are
    missing or no rim of a lens's size is found.
    """
    marks = rim_key_points(keypoints, side)
    top, bridge, inner, bottom, outer = marks
    # Three of the five lie on the nose's side, so their mean would be off.
    guess = (top + bottom) / 4 + (bridge + inner) / 8 + outer / 4
    with errors_of(f"the {SIDES[side]} lens", EyeglassesError):
        normal = rims.fit_normal(marks, vertices)
        normal = normal * np.sign(normal @ own_axes(keypoints)[2])
        rim = rims.find_lens_rim(vertices, faces, guess, rim_points=marks, normal=normal)
        if len(rim_masks):
            rim = rims.refine_lens_rim(rim, rim_masks, rim_points=marks)
        # The rim's own plane and the area's centroid in it take the place of what they were guessed to be.
        middle = rim.points.mean(0)
        axis = np.linalg.svd(rim.points - middle, full_matrices=False)[2][2]
        axis = axis * np.sign(axis @ rim.normal)
        plane = rims.LensPlane.at(middle, axis)
        x, y = (rim.points - middle) @ plane.across, (rim.points - middle) @ plane.up
        twice_area = x * np.roll(y, -1) - np.roll(x, -1) * y
        cx, cy = (((p + np.roll(p, -1)) * twice_area).sum() / (3 * twice_area.sum()) for p in (x, y))
        rim = replace(rim, normal=axis, center=middle + cx * plane.across + cy * plane.up)
        radius = norms(rim.points - rim.center).mean()
        # From a reader's slit to a diving mask: others are not millimetres.
        if not 5 <= radius <= 100:
            said = f"its mean radius is {radius:.3g} mm, which no lens has"
            raise EyeglassesError(f"{said}; give everything in millimetres, as dioptres depend on it")
        plane = rim.plane
        seated = rim.points + seat_mm * rim.measured[:, None] * plane.directions(plane.angles(rim.points))
        fan, triangles = lens_mesh(rim.center, seated, rim.normal)
    at = rim.center if center is None else center - ((center - rim.center) @ rim.normal) * rim.normal
    optics = ThinLens(at, rim.normal, material.dioptres)
    return InsertedLens(side, material, rim, fan, triangles, optics, RayCaster(fan, triangles))


def rim_key_points(keypoints: FloatArray, side: int) -> FloatArray:
    """Return a rim's key points (5, 3): top, bridge, inner, bottom, outer.

    Raises EyeglassesError, naming key point and lens, when one is missing.
    """
    marks = keypoints[RIMS[side]]
    missing = [KEY_POINT_NAMES[i] for i in RIMS[side] if not all_finite(keypoints[i])]
    if missing:
        said = f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
        advice = "give them, or None in place of this lens"
        raise EyeglassesError(f"the {SIDES[side]} lens needs the key points of its rim, but {said}; {advice}")
    return marks


def lens_mesh(
    center: ArrayLike, rim: ArrayLike, normal: ArrayLike | None = None
) -> tuple[FloatArray, IntArray]:
    """Return vertices (R + 1, 3), `center` (3,) the first, and faces (R, 3) of a fan to the `rim` (R, 3).

    The rim, R >= 3, runs in order around the lens. Normals point to the side from which it runs
    counterclockwise, or along `normal`. EyeglassesError when the fan would fold, as the rim does not go
    around the centre once; ValueError when an array has the wrong shape or is not finite.
    """
    middle = checked_array(center, (3,), "center", finite=ValueError)
    outline = checked_array(rim, ("R", 3), "rim", finite=ValueError)
    if len(outline) < 3:
        raise ValueError(f"a rim needs three points or more, got {len(outline)}")
    vertices = np.concatenate([middle[None], outline])
    numbers = np.arange(1, len(vertices))
    faces = np.stack([np.zeros_like(numbers), numbers, np.roll(numbers, -1)], 1)
    # Taken around the centre: far from the origin the cross products would lose their digits.
    cross = face_cross_products(vertices - middle, faces)
    axis = cross.sum(0)
    if normal is not None and np.asarray(normal, float) @ axis < 0:
        faces, cross, axis = faces[:, [0, 2, 1]], -cross, -axis
    folded = ~(cross @ axis > 0)
    if folded.any():
        said = f"{folded.sum()} of {len(faces)} triangles fold"
        advice = "move the centre inside, or put the points in order"
        raise EyeglassesError(f"the rim does not go around the lens centre once: {said}; {advice}")
    return vertices, faces


def without_glass(
    frame: Surface, lenses: Sequence[InsertedLens], keypoints: FloatArray
) -> tuple[Surface, Texts]:
    """Return a frame without parts across a lens, and notes, also on glass of one piece with the rim."""
    vertices, faces = frame.vertices, frame.faces
    kept, notes = np.ones(len(faces), bool), []
    for lens in lenses:
        marks = rim_key_points(keypoints, lens.side)
        panes = rims.pane_faces(vertices, faces[kept], lens.rim.plane, marks)
        if panes.any():
            kept[np.flatnonzero(kept)[panes]] = False
            count = panes.sum()
            notes.append(f"the {lens.name}: the frame's own glass there, {count} faces, is left out")
        if rims.is_covered(vertices, faces[kept], lens.rim.plane, marks):
            said = "the frame covers it, it seems by glass of one piece with the rim, which may have been"
            notes.append(f"the {lens.name}: {said} taken for the rim; cut it out of the mesh")
    if not kept.all():
        uv = frame.uv
        frame = replace(frame, faces=faces[kept], uv=uv[kept] if uv is not None and uv.ndim == 3 else uv)
    return frame, tuple(notes)


@dataclass(frozen=True)
class LensCrossings:
    """M rays at one lens; arrays are (M, 3), `ray` (M,) says which of the rays that were traced.

    `position` is on the lens, mm; `direction` and `mirrored` are unit vectors of the ray that arrives and of
    its reflection; the shares are those of tint (0 for filters) and reflection in the ray's colour.
    """

    ray: IntArray
    lens: InsertedLens
    position: FloatArray
    direction: FloatArray
    mirrored: FloatArray
    tint_share: FloatArray
    mirror_share: FloatArray


@dataclass
class LensPaths:
    """N rays behind all lenses they pass; changed while they are traced.

    `rays` run from the last lens passed, or the camera; `share` (N, 3) is that of the scene behind the lenses
    in the ray's colour, `first` (N,) the side of the first lens passed, -1 for none, `bent` (N,) whether a
    lens changed the direction. For `glancing` rays, along a lens plane, that lens was left out.
    """

    rays: SceneRays
    share: FloatArray
    first: IntArray
    bent: BoolArray
    crossings: list[LensCrossings] = field(default_factory=list)
    glancing: int = 0


def trace_lenses(scene: LensScene, lenses: Sequence[InsertedLens], seen: SceneRays) -> LensPaths:
    """Follow the rays `seen` through lenses to the scene; no ray passes a lens twice."""
    count = len(seen.origins)
    own = seen.chosen(np.arange(count))
    paths = LensPaths(own, np.ones((count, 3)), np.full(count, -1), np.zeros(count, bool))
    ahead = np.ones((count, len(lenses)), bool)
    waiting = np.arange(count if len(lenses) else 0)
    while len(waiting):
        distance = np.full((len(waiting), len(lenses)), np.inf)
        for k, lens in enumerate(lenses):
            open_ = ahead[waiting, k]
            ray = waiting[open_]
            distance[open_, k] = lens.caster.first_hit(own.origins[ray], own.directions[ray]).distance
        which, nearest = distance.argmin(1), distance.min(1)
        meets = nearest < own.hits.distance[waiting]
        waiting, which, nearest = waiting[meets], which[meets], nearest[meets]
        ahead[waiting, which] = False
        for k, lens in enumerate(lenses):
            here = which == k
            glancing = np.abs(own.directions[waiting] @ lens.rim.normal) <= _GLANCING
            glancing |= nearest <= _GLANCING
            paths.glancing += (here & glancing).sum()
            if not (here := here & ~glancing).any():
                continue
            rays, material = waiting[here], lens.material
            normal, center = lens.rim.normal, np.asarray(lens.optics.center)
            heading, before = own.directions[rays], own.origins[rays]
            position = before + heading * nearest[here][:, None]
            # Rims are not flat: the lens's plane is moved along its normal to where each ray meets the mesh.
            height = ((position - center) @ normal)[:, None] * normal
            mirrored = mirror_on_sphere(position - height, heading, center, normal, material.front_radius_mm)
            alpha, beta = np.full(len(rays), material.alpha), np.full(len(rays), material.beta)
            if material.fresnel:
                cosine = np.sqrt(np.clip((1 - dots(heading, mirrored)) / 2, 0, 1))
                beta = material.beta + (1 - material.beta) * (1 - cosine) ** 5
                # All other shares shrink alike, so that together they stay 1.
                alpha = alpha * (1 - beta) / max(1 - material.beta, SMALLEST)
            rest, tint = np.maximum(1 - alpha - beta, 0.0)[:, None], alpha[:, None]
            if material.tinting == "filter":
                rest, tint = rest + tint * np.asarray(material.tint_linear), np.zeros_like(tint)
            arriving = paths.share[rays]
            shares = arriving * tint, arriving * beta[:, None]
            paths.crossings.append(LensCrossings(rays, lens, position, heading, mirrored, *shares))
            paths.share[rays] = arriving * rest
            paths.first[rays] = np.where(paths.first[rays] < 0, lens.side, paths.first[rays])
            if lens.optics.dioptres != 0:
                own.origins[rays] = position
                own.directions[rays] = refract(lens.optics, before - height, position - height).directions
                paths.bent[rays] = True
                hits = scene.first_hit(position, own.directions[rays])
                own.hits.face[rays], own.hits.barycentric[rays] = hits.face, hits.barycentric
                own.hits.distance[rays] = hits.distance
    return paths
