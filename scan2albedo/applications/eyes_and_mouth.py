"""`eyes_and_mouth`: eyeballs behind a face's lids and the inside of its mouth, as meshes of their own."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares, minimize
from scipy.spatial import cKDTree
from scipy.special import expit

from scan2albedo.applications.face_features import FLOOR, named_texels, without_catchlights
from scan2albedo.applications.processed_face import Eyeball, EyesAndMouth, ProcessedFace
from scan2albedo.applications.template_baking import REACH_MM, TemplateTexture
from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import FloatArray, IntArray, smoothstep
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import grid_faces, lengths, normalized, vertex_normals
from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.io.glb import GlbPart

LANDMARKS: dict[str, Any] = {
    "right": slice(36, 42), "left": slice(42, 48), "rim": slice(60, 68),
    "lips": [48, 50, 51, 52, 54, 56, 57, 58], "jaw": [8, 57],
}  # fmt: skip
"""Of iBUG-68: around each eye, a corner, two of the upper lid, a corner, two of the lower lid; the lips'
inner rim, from its right corner over the upper lip; those of the outer rim beside them, which are on one lip
even where lips touch; chin and lower lip, between which the lower teeth move."""
SIZES_MM: dict[str, Any] = {
    "globe": (12.0, 0.5), "iris": (5.85, 0.25), "cornea": 7.8, "pupil": 1.75, "ring": 0.25,
    "lid": (1.0, 0.7), "film": 2.0, "edge": 0.35, "aim": (0.36, 0.4),
    "outline": (0.8, 0.8, 0.8, 0.8, 1.5, 1.0, 1.2, 1.0, 2.5, 1.5, 0.15),
    "lip": 8.0, "tooth": 7.5, "mouth": (29.0, 16.0, 40.0),
}  # fmt: skip
"""Radii of an adult's eyeball [1]_ and iris [2]_, mean and deviation among people, of the cornea [3]_, and of
a pupil in a room; steps of an eyeball's colours. How far a lid's rim, as a scan shows it, lies above the
eyeball, and its deviation; how far a scan's surface between the lids does at most; width over which a texture
goes from one thing to the next; deviations at its surface of one eye's gaze from the other's, and of an iris
that was found; of an outline, see `_inside`, from that of its landmarks. Thickness of lips, width of a tooth,
half of a mouth's width and height, and its depth.

.. [1] I. Bekerman, P. Gottlieb, M. Vaiman, "Variations in eyeball diameters of the healthy adults", Journal
   of Ophthalmology, 2014.
.. [2] F. Rüfer, A. Schröder, C. Erb, "White-to-white corneal diameter", Cornea 24(3), 2005.
.. [3] A. Gullstrand's eye, in D. Atchison, G. Smith, "Optics of the Human Eye", 2000.
"""
LOOKS: dict[str, Any] = {
    "white": ((-0.3, 0.1, -0.1), (0.4, 0.15, 0.2)), "iris": ((-1.3, 0.1, -0.1), (0.6, 0.25, 0.3)),
    "socket": ((-0.3, 0.1, -0.1), (0.6, 0.3, 0.3)), "lashes": ((-0.8, 0, 0), (0.6, 0.25, 0.25)),
    "lashed": 0.1, "unseen": (0.01, 0.7), "shade": 0.45, "wet": (0.025, 200.0),
    "brown": (0.17, 0.09, 0.055), "pupil": 0.03, "limbus": 0.5,
}  # fmt: skip
"""Means and deviations of mean log albedo relative to skin, log R/G and log B/G; those of white and iris
learn from the scan; those of a socket and of lashes are relative to skin in all three. Part of the skin that
is lashes; parts that a scan does not show, of skin and painted eyes, and of holes between lids; how much of
the light, as a logarithm, lids keep from an eye; reflectance of tears, of an index of 1.376, and Phong's
exponent of what they wet. Albedo of most people's irises and of a pupil, as parts of the white's, and of an
iris's rim, as a part of the iris's."""


def eyeball_mesh(eye: Eyeball) -> GlbPart:
    """Return an eyeball as a mesh: a sphere with the cornea's cap on it, one surface."""
    edge = math.asin(eye.iris_mm / eye.radius_mm)
    behind = np.linspace(1.6 * edge, math.pi - 1e-4, 20)
    polar = np.concatenate([np.linspace(1e-4, 1.6 * edge, 48), behind[1:]])
    around = np.linspace(0, 2 * math.pi, 48, endpoint=False)
    # Where the cornea, a sphere about a point on the gaze, stands out of the eyeball.
    axial = math.sqrt(eye.radius_mm**2 - eye.iris_mm**2) - math.sqrt(SIZES_MM["cornea"] ** 2 - eye.iris_mm**2)
    out = axial * np.cos(polar) + np.sqrt(
        np.maximum(SIZES_MM["cornea"] ** 2 - (axial * np.sin(polar)) ** 2, 0.0)
    )
    radius = np.where(polar < edge, out, eye.radius_mm)
    off, along = radius * np.sin(polar), radius * np.cos(polar)
    places = [np.outer(off, np.cos(around)), np.outer(off, np.sin(around)), along[:, None]]
    across = normalized(np.cross([0.0, 1.0, 0.0], eye.gaze))
    frame = np.stack([across, np.cross(eye.gaze, across), eye.gaze])
    vertices = eye.center_mm + np.stack(np.broadcast_arrays(*places), -1).reshape(-1, 3) @ frame
    steps = np.arange(len(eye.rings_linear)) * SIZES_MM["ring"]
    colors = [np.interp(np.where(along > 0, off, steps[-1]), steps, c) for c in eye.rings_linear.T]
    faces = grid_faces(len(polar), len(around), wrap=True)
    return _wet(f"eye_{eye.side}", vertices, faces, np.repeat(np.stack(colors, -1), len(around), 0))


def eyes_and_mouth(face: ProcessedFace) -> EyesAndMouth:
    """Return eyeballs, where the lids are open, and the inside of the mouth of a processed face.

    An eye is the outline of its lids and the circle of its iris [1]_, found as the likeliest ones under
    priors from the landmarks and from what is known of eyes. Three explanations of both eyes compete: the
    texture shows eyes, the scan has holes between open lids, or the lids are shut. A mouth is seen in place
    of what the scan does not show between open lips. Teeth are usual ones.

    Parameters
    ----------
    face : ProcessedFace
        With landmarks and an albedo; without them there are no parts.

    References
    ----------
    .. [1] A. Yuille, P. Hallinan, D. Cohen, "Feature extraction from faces using deformable templates",
       International Journal of Computer Vision 8(2), 1992.
    """
    require_type(face, ProcessedFace, "eyes_and_mouth: face", "load_result(folder) returns one")
    landmarks, cut_mm, eyes = face.landmarks, np.full(face.mask.shape, -6.0), list[Eyeball]()
    if landmarks is None or not face.has_albedo:
        why = "the face has no landmarks" if landmarks is None else "there is no albedo"
        return EyesAndMouth((), (), cut_mm, np.full((2, 2), np.nan), f"eyes and mouth are left out: {why}")
    openings = {side: _Opening(face, landmarks[LANDMARKS[side]]) for side in ("right", "left")}
    odds = np.array([one.odds for one in openings.values()])
    hole = int(np.argmax(np.maximum(odds, 0.0).sum(0)))
    shown = {side: one for side, one in openings.items() if one.odds[hole] > 0}
    if hole and len(shown) > 1:  # lids around holes are as high as each other
        right, left = (one.outlines[hole] for one in shown.values())
        right[[4, 6]] = left[[4, 6]] = (right[[4, 6]] + left[[4, 6]]) / 2
    globes = {side: one.globe(hole) for side, one in shown.items()}
    if shown:
        # Both are alike and look the same way. What an iris lies beside its place is in part the eyeball's,
        # in part its own gaze's, in part an error. Unseen eyes look ahead.
        radius = float(np.mean([globe[3] for globe in globes.values()]))
        iris_mm = min(float(np.mean([one.outlines[hole][10] for one in shown.values()])), radius / 2 + 1)
        off = {side: one.outlines[hole][8:10] - globes[side][:2] for side, one in shown.items()}
        both = np.mean(list(off.values()), axis=0)
        variance = np.square([SIZES_MM["lid"][1], *SIZES_MM["aim"]])
        moved, turned, _ = (variance / variance.sum())[:, None] * (not hole)
        centers = {side: globe[:3] + [*moved * (off[side] - both), 0] for side, globe in globes.items()}
        aims = {side: ((not hole) * both + turned * (one - both)) / radius for side, one in off.items()}
        rings = np.mean([one.rings(hole, iris_mm) for one in shown.values()], axis=0)
    for side, one in shown.items():
        aim, center = aims[side], centers[side]
        gaze = np.array([*aim, math.sqrt(1 - min(float(aim @ aim), 1.0))])
        eyes.append(Eyeball(side, one.middle + center, radius, iris_mm, gaze, not hole, rings))
        inside = _inside(one.outlines[hole], one.place)
        # Not where the skin stands far before the eyeball: a corner of the eye is the scan's.
        off_axis = np.hypot(*(one.place - center)[:, :2].T)
        behind = np.sqrt(np.maximum(radius**2 - off_axis**2, 0.0))
        inside[2] = np.minimum(SIZES_MM["film"] - (one.place[:, 2] - center[2] - behind), radius - off_axis)
        cut_mm[one.rows, one.columns] = np.maximum(inside.min(0), -6)
    seen = "as the texture shows it" if not hole else "which the scan left out: brown, looking ahead"
    reason = (
        f"{'both eyes' if len(eyes) == 2 else 'one eye'}, {seen}" if eyes else "the eyes are shut or unseen"
    )
    skin = math.exp(np.mean([one.skin[0, 0] for one in openings.values()]))
    white = eyes[0].rings_linear[-1] if eyes else skin * np.exp(_log_rgb(np.array(LOOKS["white"][0])))
    parts = [eyeball_mesh(eye) for eye in eyes] + _mouth(face, landmarks, white)
    cut_mm[named_texels(face, ["between_lips"]) & ~face.image.seen] = 1
    return EyesAndMouth(tuple(eyes), tuple(parts), np.where(face.mask, cut_mm, -6), odds, reason)


def on_template(
    inside: EyesAndMouth, fitted: FittedFace, gain: float, made: TemplateTexture
) -> TemplateTexture:
    """Return a baked mesh of a fitted face with eyes and mouth behind its openings, but those it has itself.

    Parameters
    ----------
    inside : EyesAndMouth
    fitted : FittedFace
        Whose surface carries the chart of `inside`.
    gain : float
        Of the mesh's colours to those of `inside`.
    made : TemplateTexture
        In the frame of the fitted face.
    """
    parts, places, cut_mm = list[GlbPart](), made.vertices, np.full(len(made.vertices), -6.0)
    outward = vertex_normals(places, made.faces)
    for part in inside.parts:
        # An eyeball of a template's own is round behind, too; a mouth of its own lies where ours would.
        middle, half = np.mean(part.vertices, axis=0), np.ptp(part.vertices, axis=0) / 2
        away = places - middle
        own = (np.abs(away) < half).all(1) & (away[:, 2] < 0)
        if part.name.startswith("eye"):
            own = (np.abs(lengths(away) - half[0]) < SIZES_MM["lid"][0]) & (away[:, 2] < -half[2] / 2)
            own &= np.einsum("nc,nc->n", outward, away) > 0
        if not own.any():
            parts.append(replace(part, color_linear=gain * np.asarray(part.color_linear)))
    if len(parts) == len(inside.parts):
        hits = surface_query(fitted.vertices, fitted.faces).query(places)
        pixels = pixels_from_uv(hits.interpolated(fitted.uv, fitted.faces), inside.cut_mm.shape)
        near = hits.distance < REACH_MM
        cut_mm[near] = bilinear(inside.cut_mm[..., None], pixels[near])[:, 0]
    nearest = None if fitted.landmarks is None else cKDTree(places).query(fitted.landmarks)[1]
    return replace(made, parts=tuple(parts), cut_mm=cut_mm, landmarks=nearest)


class _Opening:
    """What a chart shows around one eye; places are in mm from the `middle` (3,) between its corners.

    `outlines` (2, 11) are the likeliest ones of an eye that is shown, and of one that was left out as a hole;
    `odds` (2,) the log odds of each against lids that are shut; `classes` (2, 2, 3) means and deviations of
    the colours of white and iris, `skin` (2, 3) those of the skin beside the eye.
    """

    def __init__(self, face: ProcessedFace, landmarks: FloatArray) -> None:
        middle = landmarks[[0, 3]].mean(0)
        near = np.abs(face.image.position - middle) < (20, 12, 25)
        rows, columns = np.nonzero(face.mask & near.all(-1))
        place = face.image.position[rows, columns] - middle
        floor = FLOOR * max(face.level(), FLOOR)
        log_albedo = np.log(np.maximum(without_catchlights(face)[rows, columns], floor))
        color = np.stack([log_albedo.mean(1), *(log_albedo[:, [0, 2]] - log_albedo[:, [1]]).T], 1)
        # An outline through the landmarks; skin is what lies beside it.
        corners = landmarks[:, :2] - middle[:2]
        (ax, ay), (bx, by) = corners[[0, 3]]
        x, y = corners[[1, 2, 4, 5]].T
        along = np.clip((x - ax) / (bx - ax), 0.1, 0.9)
        high = (y - ay - along * (by - ay)) / (4 * along * (1 - along)) ** 0.5
        up, down = max(high[:2].mean(), 1.0), max(-high[2:].mean(), 1.0)
        start = np.array([ax, ay, bx, by, up, 0, down, 0, 0, (up - down) / 3, SIZES_MM["iris"][0]])
        wide = start + [-3, 0, 3, 0, 3, 0, 3, 0, 0, 0, 0]
        seen, xy = face.image.seen[rows, columns], place[:, :2]
        usual = [[math.log(floor / FLOOR), 0, 0]]  # also where no skin is seen
        outside = _inside(wide, xy)[:2].min(0) < 0
        beside, seen_beside = np.concatenate([color[seen & outside], usual]), (seen & outside).sum()
        middle_color = np.median(beside, axis=0)
        skin = np.stack([middle_color, 1.4826 * np.median(np.abs(beside - middle_color), axis=0)])
        skin[1] = np.maximum(skin[1], (0.12, 0.05, 0.05))
        chosen = np.random.default_rng(0).permutation(len(rows))[:700]
        weight = float(np.median(face.image.texel_areas_mm2())) / 5 * len(rows) / max(len(chosen), 1)
        seen, xy, shade, tone = seen[chosen], xy[chosen], color[chosen], skin[0] * (1, 0, 0)
        # Log likelihood (N,) of what is seen, or not, on skin with its lashes.
        # As much of the skin is unseen between the lids as beside them: a part not scanned is no hole.
        lacking = max(LOOKS["unseen"][0], 1 - (seen_beside + 1) / (outside.sum() + 1))
        part, skin_beside = LOOKS["lashed"], skin[0] * [[1], [0]]
        bare = math.log(1 - part) + _log_normal(shade, skin)
        bare = np.logaddexp(bare, math.log(part) + _log_normal(shade, LOOKS["lashes"] + skin_beside))
        bare = np.where(seen, bare + math.log(1 - lacking), math.log(lacking))
        socket = LOOKS["socket"] + skin_beside - [tone, np.zeros(3)]
        kinds = np.array([[LOOKS["white"], LOOKS["iris"]], [socket, socket]]) + np.stack([tone, np.zeros(3)])

        def explained(
            of_white: FloatArray, of_iris: FloatArray, first: FloatArray
        ) -> tuple[FloatArray, float, FloatArray]:
            """Return the likeliest outline, its log likelihood, and the parts (2, N) of white and iris."""
            top = np.maximum.reduce([bare, of_white, of_iris])
            likelihood = np.exp(np.stack([bare, of_white, of_iris]) - top)

            def cost(outlines: FloatArray) -> FloatArray:
                mixed = (_members(outlines, xy) * likelihood).sum(-2)
                fits = weight * (np.log(mixed + 1e-12) + top).sum(-1)
                return 0.5 * (((outlines - start) / SIZES_MM["outline"]) ** 2).sum(-1) - fits

            def with_slope(outline: FloatArray) -> tuple[float, FloatArray]:
                values = cost(np.vstack([outline, outline + 1e-4 * np.eye(len(outline))]))
                return values[0], (values[1:] - values[0]) / 1e-4

            tried = first + np.array(
                [(*np.zeros(8), dx, dy, 0) for dx in range(-6, 7, 2) for dy in range(-2, 3)]
            )
            best = minimize(
                with_slope,
                tried[np.argmin(cost(tried))],
                jac=True,
                method="L-BFGS-B",
                options={"maxiter": 20},
            )
            parts = _members(best.x, xy) * likelihood
            return best.x, -best.fun, parts[1:] / parts.sum(0)

        found = []
        for unseen, classes in zip((lacking, LOOKS["unseen"][1]), kinds, strict=True):
            outline = start
            for _ in range(2):
                likely = [_log_normal(shade, one) + math.log(1 - unseen) for one in classes]
                likely = [np.where(seen, one, math.log(unseen)) for one in likely]
                outline, fits, parts = explained(likely[0], likely[1], outline)
                counted, prior = weight * seen * parts, 20
                total = prior + counted.sum(1)[:, None]
                mean = (prior * classes[:, 0] + counted @ shade) / total
                square = np.einsum("kn,knc->kc", counted, (shade - mean[:, None]) ** 2)
                classes[:] = np.stack([mean, np.sqrt((prior * classes[:, 1] ** 2 + square) / total)], 1)
            found.append((outline, fits))
        # Schwarz's criterion: each number of an outline costs half the log of the observations.
        shut = weight * bare.sum() + len(start) / 2 * math.log(max(weight * len(chosen), 1.0))
        outlines, odds = (np.array(of_kinds) for of_kinds in zip(*found, strict=True))
        self.middle, self.rows, self.columns, self.place, self.color = middle, rows, columns, place, color
        self.skin, self.classes, self.outlines, self.odds = skin, kinds[0], outlines, odds - shut

    def globe(self, hole: int) -> FloatArray:
        """Return centre and radius (4,) of the eyeball on which the lids' rims lie."""
        ax, ay, bx, by, up, up_slant, down, down_slant = self.outlines[hole][:8]
        along = np.linspace(0.3, 0.7, 5)
        bulge, level = (4 * along * (1 - along)) ** 0.5, ay + along * (by - ay)
        rims = [
            level + bulge * (up + up_slant * (along - 0.5)),
            level - bulge * (down + down_slant * (along - 0.5)),
        ]
        on_rims = np.stack([np.tile(ax + along * (bx - ax), 2), np.concatenate(rims)], 1)
        rim = self.place[cKDTree(self.place[:, :2]).query(on_rims)[1]]
        middle = np.array([(ax + bx) / 2, (ay + by) / 2])

        (lid, unsure), (usual, spread) = SIZES_MM["lid"], SIZES_MM["globe"]

        def off(globe: FloatArray) -> FloatArray:
            above = np.linalg.norm(rim - globe[:3], axis=1) - globe[3] - lid
            above[above < 0] /= 3  # scans have dents at eyes, and no bumps
            return np.array([*above, *globe[:2] - middle, (globe[3] - usual) * unsure / spread]) / unsure

        return least_squares(off, [*middle, rim[:, 2].mean() - usual, usual]).x

    def rings(self, hole: int, iris_mm: float) -> FloatArray:
        """Return (K, 3) the eyeball's albedo away from the middle of its iris, as far as it is known."""
        ring, pupil_mm = SIZES_MM["ring"], SIZES_MM["pupil"]
        away, tone = ring * np.arange(math.ceil((iris_mm + 1) / ring) + 1), self.skin[0] * (1, 0, 0)
        # Lids shade the eye, and no light that was found does: what the white lacks all of the eye lacks.
        usual = tone + LOOKS["white"][0] + (LOOKS["shade"], 0, 0)
        brighter = not hole and self.classes[0, 0, 0] > usual[0]
        white = np.exp(_log_rgb(self.classes[0, 0] if brighter else usual))
        off, within = (
            np.hypot(*(self.place[:, :2] - self.outlines[hole][8:10]).T),
            _inside(self.outlines[hole], self.place),
        )
        colored = (off > pupil_mm) & (off < iris_mm - 1) & (within[:2].min(0) > 1)
        iris = white * LOOKS["brown"]
        if not hole and colored.any():
            shade = max(usual[0] - self.classes[0, 0, 0], 0.0)
            iris = np.exp(_log_rgb(np.median(self.color[colored], axis=0)) + shade)
        made = LOOKS["pupil"] * white + np.zeros((len(away), 1))
        changes = (pupil_mm, iris), (iris_mm - 3 * ring, iris * LOOKS["limbus"]), (iris_mm, white)
        for edge, color in changes:
            made += smoothstep(0.5 + (away - edge) / (2 * ring))[:, None] * (color - made)
        return made


def _inside(outline: FloatArray, xy: FloatArray) -> FloatArray:
    """Return (3, ..., N) how many mm points are below the upper lid, above the lower, and inside the iris.

    An `outline` (..., 11) has the corners (x, y), a parabola's height and slant of the upper and of the lower
    lid, and middle and radius of the iris; of it (..., 3, N).
    """
    ax, ay, bx, by, up, up_slant, down, down_slant, *iris = np.moveaxis(outline, -1, 0)[..., None]
    along = (xy[:, 0] - ax) / (bx - ax)
    level, bulge = ay + along * (by - ay), 4 * along * (1 - along)
    bulge = np.sign(bulge) * np.abs(bulge) ** 0.5
    below = level + bulge * (up + up_slant * (along - 0.5)) - xy[:, 1]
    above = xy[:, 1] - level + bulge * (down + down_slant * (along - 0.5))
    return np.stack([below, above, iris[2] - np.hypot(xy[:, 0] - iris[0], xy[:, 1] - iris[1])])


def _members(outline: FloatArray, xy: FloatArray) -> FloatArray:
    """Return (..., 3, N) how far points are skin, an eyeball's white, and iris, by an outline (..., 11)."""
    below, above, iris = expit(_inside(outline, xy) / SIZES_MM["edge"])
    inside = below * above
    return np.stack([1 - inside, inside * (1 - iris), inside * iris], -2)


def _log_normal(values: FloatArray, mean_and_deviation: ArrayLike) -> FloatArray:
    """Return (N,) the log density of values (N, 3), but for a constant."""
    mean, deviation = np.asarray(mean_and_deviation)
    return -0.5 * (((values - mean) / deviation) ** 2).sum(-1) - np.log(deviation).sum()


def _log_rgb(color: FloatArray) -> FloatArray:
    """Return log R, G, B (3,) of mean log albedo, log R/G and log B/G."""
    level, red, blue = color
    green = level - (red + blue) / 3
    return np.array([green + red, green, green + blue])


def _wet(
    name: str, vertices: FloatArray, faces: IntArray, colors: FloatArray, follows: FloatArray | None = None
) -> GlbPart:
    # Phong's exponent as the roughness of a GGX lobe of the same width, see `engine_maps`.
    return GlbPart(name, vertices, faces, colors, 1.0, (2 * LOOKS["wet"][1] + 1) ** (-1 / 4), follows)


def _mouth(face: ProcessedFace, landmarks: FloatArray, white: FloatArray) -> list[GlbPart]:
    """Return the inside of a mouth as a bag behind the lips' inner rim, and both rows of teeth."""
    rim, knots = landmarks[LANDMARKS["rim"]], np.linspace(0, 1, 9)
    # How a closed curve through the eight landmarks follows them: (C, 8).
    around = np.linspace(0, 1, 40, endpoint=False)
    blend = CubicSpline(knots, np.vstack([np.eye(8), np.eye(8)[:1]]), bc_type="periodic")(around)
    # It begins behind the lips, wider than they are open, and is as wide as a mouth before the teeth.
    middle, back = rim.mean(0), np.linspace(0, 1, 16)[:, None, None] ** 2
    angle = math.pi - 2 * math.pi * around
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    lip_mm, (*half, depth) = SIZES_MM["lip"], SIZES_MM["mouth"]
    wide = smoothstep(2 * depth * back / lip_mm)
    start = blend @ rim + lip_mm / 4 * np.column_stack([circle * (0, 2), np.full(len(circle), -4)])
    xy = (1 - wide) * start[:, :2] + wide * (middle[:2] + np.sqrt(1 - back**2) * half * circle)
    z = (1 - back) * start[:, 2:] + back * middle[2] - depth * back
    bag = np.concatenate([xy, np.broadcast_to(z, (*xy.shape[:2], 1))], -1)
    follows = np.zeros((*bag.shape[:2], 68))
    follows[..., LANDMARKS["lips"]] = (1 - wide) * blend
    below = wide[..., 0] * np.clip(-np.sin(angle), 0, 1) * (1 - back[..., 0])
    follows[..., LANDMARKS["jaw"]] += below[..., None] / 2
    lips = named_texels(face, ["lip", "upper_lip", "lower_lip"]) & face.image.seen
    red = np.median(face.albedo_linear[lips], axis=0) if lips.any() else white * (0.5, 0.25, 0.2)
    faces = grid_faces(*bag.shape[:2], wrap=True)
    gums = 0.7 * red
    colors = np.repeat((1 - 0.8 * np.sqrt(back[:, 0])) * gums, len(around), axis=0)  # dark inside
    parts = [_wet("mouth", bag.reshape(-1, 3), faces, colors, follows.reshape(-1, 68))]
    # Each row of teeth: half an ellipse from gums over the edges and back to the gums.
    turn = np.radians(np.linspace(-75, 75, 121))
    arch = np.stack([27 * np.sin(turn), 38 * (np.cos(turn) - 1)], -1)
    along = np.cumsum(np.linalg.norm(np.diff(arch, axis=0, prepend=arch[:1]), axis=1))
    gap = np.exp(
        -(((along - along[60] + SIZES_MM["tooth"] / 2) % SIZES_MM["tooth"] - SIZES_MM["tooth"] / 2) ** 2)
    )
    for name, lip, up, inward in (("teeth_upper", rim[2], 1, 0.0), ("teeth_lower", rim[6], -1, 2.5)):
        rows = []
        for high, thick in ((10, 0.0), (0, 0.0), (0, 2.0), (10, 5.0)):
            shrunk = arch * (1 - (thick + inward + 0.5 * gap[:, None]) / 30)
            y = np.full(len(arch), lip[1] + up * (high - 2 * (up > 0)))
            z = min(rim[2, 2], rim[6, 2]) - lip_mm - thick - inward + shrunk[:, 1]
            rows.append(np.stack([middle[0] + shrunk[:, 0], y, z], -1))
        tooth = white * (1.1, 1.03, 0.9) * (1 - 0.6 * gap[:, None])
        colors = np.concatenate([np.tile(gums, (len(arch), 1)) if k in (0, 3) else tooth for k in range(4)])
        moves = np.zeros((len(colors), 68))
        moves[:, LANDMARKS["jaw"]] = (up < 0) / 2
        strip = grid_faces(4, len(arch))[:, ::up]
        parts.append(_wet(name, np.concatenate(rows), strip, colors, moves))
    return parts
