"""Named extremes of eyeglasses: weights, skinning, canonical frames, registration on faces, lenses."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from scan2albedo.core import Budget
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses import (
    CanonicalizationOptions,
    DistantLights,
    LensMaterial,
    Surface,
    ThinLens,
    bounded_biharmonic_weights,
    canonicalize,
    find_lens_rim,
    insert_lenses,
    refract,
    register_on_face,
    skin,
    triangulate,
)
from scan2albedo.eyeglasses.lenses.inserted_lenses import lens_mesh
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points
from scan2albedo.synthetic import GlassesBend, GlassesShape, eyeglasses, wearer
from stability_cases.case import Cases, Measured, assert_finite, naming

CASES = Cases()
STAGE = "eyeglasses"
SPACING = 3.0
FRONT = DistantLights([[0, 0, 1]], [np.pi])


@cache
def _frame() -> Any:
    return eyeglasses()


@cache
def _plain() -> FloatArray:
    frame = _frame()
    return bounded_biharmonic_weights(frame.vertices, frame.faces, frame.keypoints, SPACING)


def _weights(vertices: Any, faces: Any, handles: Any, spacing: Any = SPACING) -> FloatArray:
    weights = bounded_biharmonic_weights(vertices, faces, handles, spacing)
    assert_finite(weights)
    assert np.abs(weights.sum(1) - 1).max() <= 1e-12
    assert weights.min() >= 0
    return weights


def _box(center: Any, half: float) -> tuple[FloatArray, IntArray]:
    import trimesh

    box = trimesh.creation.box([2 * half] * 3)
    return np.asarray(box.vertices) + center, np.asarray(box.faces)


def _joined(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    frame = _frame()
    return np.vstack([frame.vertices, vertices]), np.vstack([frame.faces, faces + len(frame.vertices)])


# Weights.


@CASES.extreme(STAGE, "weights: coincident key points", "named error")
def _coincident() -> str:
    frame = _frame()
    return str(_weights(frame.vertices, frame.faces, np.vstack([frame.keypoints, frame.keypoints[2]])).shape)


@CASES.extreme(STAGE, "weights: key points far off the mesh", "named error")
def _off() -> str:
    frame = _frame()
    return str(_weights(frame.vertices, frame.faces, frame.keypoints + [0, 90, 0]).shape)


@CASES.extreme(STAGE, "weights: one key point")
def _one_handle() -> str:
    frame = _frame()
    assert np.all(_weights(frame.vertices, frame.faces, frame.keypoints[:1]) == 1)
    return "takes everything"


@CASES.extreme(STAGE, "weights: 2 components, one without a key point")
def _two_parts() -> str:
    frame = _frame()
    weights = _weights(*_joined(*_box(frame.keypoints[0] + [0, 60, 0], 3.0)), frame.keypoints)
    own = weights[len(frame.vertices) :]
    moved = float(np.abs(weights[: len(frame.vertices)] - _plain()).max())
    assert np.abs(own - own[0]).max() == 0
    assert moved < 1e-9
    return "the other moves in one piece, the first as without it"


@CASES.extreme(STAGE, "weights: open mesh, a fifth of the triangles gone")
def _open() -> str:
    frame = _frame()
    kept = np.random.default_rng(1).random(len(frame.faces)) > 0.2
    off = float(np.abs(_weights(frame.vertices, frame.faces[kept], frame.keypoints) - _plain()).mean())
    assert off < 0.02
    return f"weights differ by {off:.4f} on average"


@CASES.extreme(STAGE, "weights: one triangle")
def _triangle() -> str:
    corners = np.array([[0.0, 0, 0], [60, 0, 0], [0, 60, 0]])
    weights = _weights(corners, [[0, 1, 2]], corners)
    assert np.diag(weights).min() > 0.9
    return f"each corner its own, {np.diag(weights).min():.2f} at least"


@CASES.extreme(STAGE, "weights: a wire frame of 0.5 mm")
def _wire() -> str:
    thin = GlassesShape(rim_width=0.5, rim_depth=0.5, bridge_height=0.5, temple_height=0.5, temple_width=0.5)
    frame = eyeglasses(shape=thin)
    own = _weights(frame.vertices, frame.faces, frame.keypoints)[frame.keypoint_vertices]
    assert np.diag(own).min() > 0.9
    return f"key points {np.ptp(frame.keypoints[:2, 1]):.1f} mm apart: {np.diag(own).min():.2f} each at least"


@CASES.extreme(STAGE, "weights: slivers and flat triangles")
def _slivers() -> str:
    frame = _frame()
    a, b, c = frame.faces[::7].T
    faces = np.vstack([frame.faces, np.stack([a, b, a], 1), np.stack([a, b, b], 1)])
    vertices = np.vstack([frame.vertices, frame.vertices[c] * [1, 1, 1] + 1e-12])
    count = len(frame.vertices)
    faces = np.vstack([faces, np.stack([a, c, count + np.arange(len(c))], 1)])
    off = float(np.abs(_weights(vertices, faces, frame.keypoints)[:count] - _plain()).max())
    assert off < 1e-6
    return f"weights as without, within {off:.0e}"


for _name, _scale in (("metres", 1e-3), ("kilometres", 1e-6), ("micrometres", 1e3)):

    @CASES.extreme(STAGE, f"weights: glasses in {_name}", slow=_name == "kilometres")
    def _unit(scale: float = _scale) -> str:
        frame = _frame()
        weights = _weights(scale * frame.vertices, frame.faces, scale * frame.keypoints, SPACING * scale)
        off = float(np.abs(weights - _plain()).max())
        assert off < 1e-6
        return f"as in mm, within {off:.0e}"


for _shift in (1e6, 1e7):

    @CASES.extreme(STAGE, f"weights: glasses {_shift:g} mm off the origin", slow=_shift == 1e6)
    def _shifted(shift: float = _shift) -> str:
        frame = _frame()
        weights = _weights(frame.vertices + shift, frame.faces, frame.keypoints + shift)
        off = float(np.abs(weights - _plain()).max())
        assert off < 1e-3
        return f"as at the origin, within {off:.0e}"


for _name, _spoilt in (
    ("no vertex", (np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((1, 3)))),
    ("no key point", (np.eye(3), [[0, 1, 2]], np.zeros((0, 3)))),
    ("shrunk to a point", (np.zeros((9, 3)), [[0, 1, 2]], [[0, 0, 0]])),
):

    @CASES.extreme(STAGE, f"weights: {_name}", "named error")
    def _no_mesh(spoilt: Any = _spoilt) -> str:
        return str(_weights(*spoilt).shape)


@CASES.extreme(STAGE, "weights: spacing 0.001", "named error")
def _fine_spacing() -> str:
    frame = _frame()
    return str(_weights(frame.vertices, frame.faces, frame.keypoints, 1e-3).shape)


# Skinning.


@CASES.extreme(STAGE, "skinning: two halves turned by 180 degrees")
def _turned() -> str:
    weights = np.stack([np.linspace(0, 1, 11), np.linspace(1, 0, 11)], 1)
    turn = compose(rotation_from_vector([0, 0, math.pi]), np.zeros(3))
    points = np.tile([10.0, 0, 0], (11, 1))
    moved = skin(points, weights, [np.eye(4), turn])
    assert_finite(moved)
    assert abs(moved[5]).max() < 1e-12
    return "linear blending collapses half way (the candy wrapper), finite"


@CASES.extreme(STAGE, "skinning: weights NaN", "named error")
def _nan_weights() -> str:
    return str(skin(np.ones((2, 3)), np.full((2, 1), math.nan), [np.eye(4)]))


@CASES.extreme(STAGE, "skinning: transforms NaN", "named error")
def _nan_transforms() -> str:
    return str(skin(np.ones((2, 3)), np.ones((2, 1)), [np.full((4, 4), math.nan)]))


@CASES.extreme(STAGE, "skinning: no vertex")
def _nothing_to_skin() -> str:
    assert skin(np.zeros((0, 3)), np.zeros((0, 1)), [np.eye(4)]).shape == (0, 3)
    return "nothing"


# Canonical frames.

QUICK_WEIGHTS = CanonicalizationOptions(mode="mean")


def _back(bent: Any, scale: float = 1.0, shift: float = 0.0) -> tuple[Any, float]:
    """Return the canonical frame, and how far it is from the one at rest: rms in mm."""
    found = canonicalize(
        [(scale * bent.vertices + shift, bent.faces)],
        [scale * bent.keypoints + shift],
        weights=[_plain()],
        mean_keypoints=bent.rest_keypoints,
        options=QUICK_WEIGHTS,
    ).frames[0]
    assert_finite(found.vertices, found.handle_transforms)
    off = np.linalg.norm(found.vertices - bent.rest_vertices, axis=1)
    return found, float(np.sqrt((off**2).mean()))


for _name, _scale, _shift in (
    ("in metres", 1e-3, 0.0),
    ("in kilometres", 1e-6, 0.0),
    ("1e6 mm off the origin", 1.0, 1e6),
    ("1e7 mm off the origin", 1.0, 1e7),
):

    @CASES.extreme(STAGE, f"canonical: glasses {_name}")
    def _canonical_unit(scale: float = _scale, shift: float = _shift) -> str:
        _, off = _back(eyeglasses(bend=GlassesBend(temple_spread_mm=8.0)), scale, shift)
        assert off < 0.15
        return f"off by {off:.2f} mm rms"


def _bent(turn_deg: float) -> Any:
    """Return key points with the temples folded inward by an angle about their hinges, and the vertices."""
    frame, points = _frame(), _frame().keypoints.copy()
    vertices = frame.vertices.copy()
    for sign, at in ((1, 7), (-1, 16)):
        hinge = _frame().keypoints[at]
        turn = rotation_from_vector([0, sign * math.radians(turn_deg), 0])
        for moved in (points, vertices):
            side = (sign * moved[:, 0] > 60) & (moved[:, 2] < hinge[2] - 5)
            moved[side] = transform_points(compose(turn, hinge - turn @ hinge), moved[side])
    return vertices, points


@CASES.extreme(STAGE, "canonical: temples folded by 90 degrees", "measured warning")
def _folded() -> str:
    vertices, points = _bent(90)
    found = canonicalize(
        [(vertices, _frame().faces)],
        [points],
        weights=[_plain()],
        mean_keypoints=_frame().keypoints,
        options=QUICK_WEIGHTS,
    ).frames[0]
    assert_finite(found.vertices)
    off = np.sqrt((np.linalg.norm(found.vertices - _frame().vertices, axis=1) ** 2).mean())
    assert found.residual > 10
    return Measured(f"off by {off:.1f} mm rms; residual {found.residual:.0f} mm says how bent it was")


@CASES.extreme(STAGE, "canonical: temples bent back by 180 degrees", "measured warning")
def _folded_back() -> str:
    vertices, points = _bent(180)
    found = canonicalize(
        [(vertices, _frame().faces)],
        [points],
        weights=[_plain()],
        mean_keypoints=_frame().keypoints,
        options=QUICK_WEIGHTS,
    ).frames[0]
    assert_finite(found.vertices)
    back = found.uncanonicalize(found.vertices)
    assert np.abs(back - vertices).max() < 1e-4
    assert found.residual > 10
    return Measured(
        f"residual {found.residual:.0f} mm; the way back within {np.abs(back - vertices).max():.0e} mm"
    )


for _name, _points in (
    ("all at one place", np.zeros((20, 3))),
    ("on a line", np.arange(60.0).reshape(20, 3) * [1, 0, 0]),
    ("two known", np.where(np.arange(20)[:, None] < 2, 1.0, math.nan) * np.arange(60.0).reshape(20, 3)),
    ("none known", np.full((20, 3), math.nan)),
    ("infinite", np.full((20, 3), math.inf)),
):

    @CASES.extreme(STAGE, f"canonical: key points {_name}", "named error")
    @naming("frame 0: .* key points")
    def _odd_points(points: FloatArray = _points) -> str:
        frame = _frame()
        return str(canonicalize([frame], [points], weights=[_plain()], options=QUICK_WEIGHTS).iterations)


@CASES.extreme(STAGE, "canonical: glasses of half the size", "named error")
@naming("its front is .* units wide")
def _no_true_size() -> str:
    half = _frame().vertices / 2, _frame().faces
    return str(canonicalize([half], [_frame().keypoints / 2], weights=[_plain()]).iterations)


@CASES.extreme(STAGE, "canonical: weights NaN", "named error")
def _nan_frame_weights() -> str:
    frame = _frame()
    return str(
        canonicalize([frame], [frame.keypoints], weights=[np.full_like(_plain(), math.nan)])
        .frames[0]
        .vertices
    )


@CASES.extreme(STAGE, "canonical: budget of 1 evaluation", "measured warning", slow=True)
def _canonical_spent() -> str:
    frame = eyeglasses(bend=GlassesBend(temple_spread_mm=8.0))
    found = canonicalize(
        [frame],
        [frame.keypoints],
        mean_keypoints=frame.rest_keypoints,
        spacing=SPACING,
        budget=Budget(evaluations=1),
        options=QUICK_WEIGHTS,
    )
    assert not found.converged
    off = np.linalg.norm(found.frames[0].vertices - frame.rest_vertices, axis=1)
    assert_finite(off)
    return Measured(f"converged=False, off by {np.sqrt((off**2).mean()):.2f} mm rms")


# Key points from several views.


def _views(*centers: tuple[float, float, float]) -> FloatArray:
    return np.stack([look_at(c, [0, 0, 0], focal_px=900, shape=(512, 512)) for c in centers])


def _labels(cameras: FloatArray, points: FloatArray) -> FloatArray:
    image = np.einsum("cij,kj->cki", cameras[:, :, :3], points) + cameras[:, None, :, 3]
    return image[..., :2] / image[..., 2:]


THREE = _views((-300, 0, 500), (0, 50, 600), (300, 0, 500))


@CASES.extreme(STAGE, "triangulation: identical cameras", "measured warning")
def _identical() -> str:
    cameras = np.tile(THREE[:1], (3, 1, 1))
    found = triangulate(_labels(cameras, _frame().keypoints), cameras)
    assert np.isnan(found.points).all()
    assert not found.inliers.any()
    return Measured("no depth: every point NaN, as the result's fields say, no inlier")


@CASES.extreme(STAGE, "triangulation: all labels outliers (1e5 px)", "measured warning")
def _outliers() -> str:
    rng = np.random.default_rng(0)
    found = triangulate(rng.uniform(-1e5, 1e5, (3, 20, 2)), THREE)
    assert found.inliers.sum(0).max() <= 1
    return Measured("no point has inliers in two views")


for _name, _focal in (("1", 1.0), ("1e6", 1e6)):

    @CASES.extreme(STAGE, f"triangulation: focal length {_name} px")
    def _focal_length(focal: float = _focal) -> str:
        cameras = np.stack([np.diag([focal / 900, focal / 900, 1]) @ camera for camera in THREE])
        found = triangulate(_labels(cameras, _frame().keypoints), cameras, noise_px=max(focal / 900, 1e-3))
        off = float(np.abs(found.points - _frame().keypoints).max())
        assert off < 1e-4
        return f"points within {off:.0e} mm"


# Registration on a face.

SMALL = {"picture_size": 256, "focal_px": 450, "label_noise_px": 0.5, "mask_noise_px": 0.5}


@cache
def _worn() -> Any:
    return wearer(1, **SMALL)


@cache
def _own_glasses() -> tuple[Any, ...]:
    glasses = _worn().glasses
    weights = bounded_biharmonic_weights(
        glasses.rest_vertices, glasses.faces, glasses.rest_keypoints, SPACING
    )
    return glasses.rest_vertices, glasses.faces, glasses.rest_keypoints, weights


def _registered(**changes: Any) -> Any:
    worn = _worn()
    given = {
        "keypoints_2d": worn.labels,
        "masks": None,
        "cameras": worn.cameras,
        "head": (worn.head_vertices, worn.head_faces),
        "glasses": _own_glasses(),
        **changes,
    }
    found = register_on_face(
        given.pop("glasses"), given.pop("keypoints_2d"), given.pop("masks"), given.pop("cameras"), **given
    )
    assert_finite(found.vertices, found.keypoints)
    return found


def _off_mm(found: Any) -> float:
    worn = _worn()
    return float(np.sqrt((np.linalg.norm(found.vertices - worn.vertices, axis=1)[worn.seen] ** 2).mean()))


@CASES.extreme(STAGE, "registration: labels alone", slow=True)
def _labels_alone() -> str:
    off = _off_mm(_registered())
    assert off < 1.0
    return f"visible vertices off by {off:.2f} mm rms"


@CASES.extreme(STAGE, "registration: all labels outliers (1e5 px)", "named error", slow=True)
def _wild_labels() -> str:
    labels = np.random.default_rng(0).uniform(-1e5, 1e5, _worn().labels.shape)
    found = _registered(keypoints_2d=labels)
    return f"observed {found.observed.mean()}"


@CASES.extreme(STAGE, "registration: labels by chance within the pictures", "named error", slow=True)
def _chance_labels() -> str:
    labels = np.random.default_rng(0).uniform(0, 256, _worn().labels.shape)
    return f"observed {_registered(keypoints_2d=labels).observed.mean()}"


@CASES.extreme(STAGE, "registration: no labels", "named error")
@naming("no key point is labelled.*no head.*give a start")
def _no_labels() -> str:
    return str(_registered(keypoints_2d=np.full_like(_worn().labels, math.nan), head=None).converged)


@CASES.extreme(STAGE, "registration: labels infinite", "named error")
def _infinite_labels() -> str:
    return str(_registered(keypoints_2d=np.full_like(_worn().labels, math.inf), head=None).converged)


@CASES.extreme(STAGE, "registration: one camera", "measured warning", slow=True)
def _one_camera() -> str:
    worn = _worn()
    found = _registered(keypoints_2d=worn.labels[[1]], cameras=worn.cameras[[1]], head=None)
    assert not found.depth_observed
    return Measured(f"depth_observed=False; off by {_off_mm(found):.1f} mm")


@CASES.extreme(STAGE, "registration: parallel identical cameras", "measured warning", slow=True)
def _same_cameras() -> str:
    worn, same = _worn(), [1, 1, 1]
    found = _registered(keypoints_2d=worn.labels[same], cameras=worn.cameras[same], head=None)
    assert not found.depth_observed
    return Measured(f"depth_observed=False; off by {_off_mm(found):.1f} mm")


def _moved_cameras(center: Any) -> FloatArray:
    """Return the cameras, the first moved to a place in the scene, as labelled from where it was."""
    cameras = _worn().cameras.copy()
    cameras[0, :, 3] = -cameras[0, :, :3] @ np.asarray(center, float)
    return cameras


@CASES.extreme(STAGE, "registration: a camera said to be inside the glasses", "measured warning", slow=True)
def _inside() -> str:
    found = _registered(cameras=_moved_cameras(_worn().keypoints.mean(0)))
    assert not found.inliers[0].all()
    return Measured(
        f"{100 * found.inliers[0].mean():.0f} % of its labels fit, the other views decide: "
        f"off by {_off_mm(found):.1f} mm"
    )


@CASES.extreme(STAGE, "registration: a camera said to be behind the head", "measured warning", slow=True)
def _behind() -> str:
    worn = _worn()
    forward = worn.cameras[0, 2, :3] / np.linalg.norm(worn.cameras[0, 2, :3])
    found = _registered(cameras=_moved_cameras(worn.keypoints.mean(0) + 600 * forward))
    assert not found.inliers[0].any()
    return Measured(f"none of its labels fit, the other views decide: off by {_off_mm(found):.1f} mm")


@CASES.extreme(STAGE, "registration: masks empty", "measured warning", slow=True)
def _empty_masks() -> str:
    found = _registered(masks=np.zeros_like(_worn().masks))
    assert np.isnan(found.iou).all()
    row = next(step for step in found.plan if "empty" in step.reason)
    return Measured(f"off by {_off_mm(found):.2f} mm; {row.reason}")


@CASES.extreme(STAGE, "registration: masks full", "measured warning", slow=True)
def _full_masks() -> str:
    found = _registered(masks=np.ones_like(_worn().masks))
    row = next(step for step in found.plan if "covers all" in step.reason)
    return Measured(f"off by {_off_mm(found):.2f} mm; {row.reason}")


@CASES.extreme(STAGE, "registration: masks of another size", "named error")
@naming("labels of view 0 lie outside its mask of 128 x 128")
def _small_masks() -> str:
    return str(_registered(masks=_worn().masks[:, ::2, ::2]).converged)


@CASES.extreme(STAGE, "registration: masks of 1 x 1", "named error")
def _dot_masks() -> str:
    return str(_registered(masks=np.ones((3, 1, 1), bool)).converged)


for _name, _focal in (("1", 1.0), ("1e6", 1e6)):

    @CASES.extreme(STAGE, f"registration: focal length {_name} px", "named error", slow=True)
    def _wrong_focal(focal: float = _focal) -> str:
        cameras = np.stack(
            [
                np.diag([focal / SMALL["focal_px"], focal / SMALL["focal_px"], 1]) @ camera
                for camera in _worn().cameras
            ]
        )
        found = _registered(cameras=cameras)
        return f"off by {_off_mm(found):.0f} mm, observed {found.observed.mean():.2f}, {list(found.plan)}"


for _name, _scale in (("metres", 1e-3), ("kilometres", 1e-6)):

    @CASES.extreme(STAGE, f"registration: glasses in {_name}, cameras in mm", "named error")
    @naming(r"e\+0[36] times as large.*same unit")
    def _other_unit(scale: float = _scale) -> str:
        vertices, faces, points, weights = _own_glasses()
        return str(_registered(glasses=(scale * vertices, faces, scale * points, weights)).converged)


@CASES.extreme(STAGE, "registration: scene 1e6 mm off the origin", slow=True)
def _far_scene() -> str:
    worn, shift = _worn(), np.array([1e6, 0, 0])
    cameras = worn.cameras.copy()
    cameras[:, :, 3] -= cameras[:, :, :3] @ shift
    found = _registered(cameras=cameras, head=(worn.head_vertices + shift, worn.head_faces))
    off = found.vertices - shift - worn.vertices
    off_mm = float(np.sqrt((np.linalg.norm(off, axis=1)[worn.seen] ** 2).mean()))
    assert off_mm < 1.0
    return f"visible vertices off by {off_mm:.2f} mm rms"


@CASES.extreme(STAGE, "registration: head with NaN", "named error")
def _nan_head() -> str:
    worn = _worn()
    return str(_registered(head=(np.full_like(worn.head_vertices, math.nan), worn.head_faces)).converged)


for _name, _budget in (("1e-3 s", Budget(seconds=1e-3)), ("1 evaluation", Budget(evaluations=1))):

    @CASES.extreme(
        STAGE, f"registration with a budget of {_name}", "measured warning", slow=_name == "1e-3 s"
    )
    def _spent(budget: Budget = _budget) -> str:
        found = _registered(budget=budget)
        assert not found.converged
        return Measured(
            f"converged=False, {100 * found.observed.mean():.0f} % counts as observed; "
            f"off by {_off_mm(found):.0f} mm"
        )


# Lenses.


def _bend_deg(dioptres: float) -> float:
    """Return by how much a ray 20 mm off the axis is bent, against the exact thin lens, in degrees."""
    rays = refract(ThinLens([0, 0, 0], [0, 0, 1], dioptres), [0, 0, 600.0], [[20.0, 0, 0]])
    assert_finite(rays.directions)
    slope = rays.directions[0, 0] / -rays.directions[0, 2]
    return float(abs(math.degrees(math.atan(slope) - math.atan(20 / 600 - 20 * dioptres / 1000))))


for _dioptres in (-20.0, 0.0, 20.0, 1e3, 1000 / 600):

    @CASES.extreme(STAGE, f"lens of {_dioptres:g} dioptres")
    def _power(dioptres: float = _dioptres) -> str:
        off = _bend_deg(dioptres)
        assert off < 1e-9
        return f"within {off:.0e} degrees of the exact thin lens"


for _dioptres in (math.nan, math.inf):

    @CASES.extreme(STAGE, f"lens of {_dioptres} dioptres", "named error")
    @naming("not finite")
    def _no_power(dioptres: float = _dioptres) -> str:
        return str(_bend_deg(dioptres))


@CASES.extreme(STAGE, "lens seen edge-on: the camera in its plane", "named error")
@naming("camera lies in the lens plane")
def _edge_on() -> str:
    return str(refract(ThinLens([0, 0, 0], [0, 0, 1], 4.0), [600.0, 0, 0], [[20.0, 0, 0]]).directions)


@CASES.extreme(STAGE, "lens without a normal", "named error")
@naming("normal is zero")
def _no_normal() -> str:
    return str(refract(ThinLens([0, 0, 0], [0, 0, 0], 4.0), [0, 0, 600.0], [[20.0, 0, 0]]).directions)


def _wall() -> Surface:
    corners = 80 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    return Surface(np.column_stack([corners, np.full(4, -40.0)]), [[0, 1, 2], [0, 2, 3]])


def _shown(material: Any, **changes: Any) -> Any:
    frame = _frame()
    center = frame.lens_centers[0]
    given = {
        "camera": look_at(center + [0, 0, 600], center, focal_px=300, shape=(48, 64)),
        "shape": (48, 64),
        "lights": FRONT,
        **changes,
    }
    surface = Surface(frame.vertices, frame.faces, albedo_linear=(0.1, 0.1, 0.1))
    picture = insert_lenses(surface, frame.keypoints, material, surfaces=[_wall()], **given)
    assert_finite(picture.image_linear)
    assert picture.image_linear.min() >= 0
    return picture


for _dioptres in (-20.0, 20.0, 1e3):

    @CASES.extreme(STAGE, f"picture through lenses of {_dioptres:g} dioptres", slow=_dioptres != 1e3)
    def _through(dioptres: float = _dioptres) -> str:
        picture = _shown(LensMaterial(dioptres))
        assert (picture.lens >= 0).sum() > 300
        return f"finite, {int((picture.lens >= 0).sum())} pixels of lens"


@CASES.extreme(STAGE, "picture through window glass")
def _window() -> str:
    picture = _shown(LensMaterial(0.0))
    through = (picture.lens >= 0) & np.isfinite(picture.without_lenses_linear).all(-1)
    off = float(np.abs(picture.image_linear - picture.without_lenses_linear)[through].max())
    assert through.sum() > 300
    assert off < 1e-9
    return f"as without lenses within {off:.0e}"


@CASES.extreme(STAGE, "picture by a camera inside the glasses", slow=True)
def _camera_inside() -> str:
    frame = _frame()
    center = frame.keypoints.mean(0)
    camera = look_at(center, center + [0, 0, -100.0], focal_px=30, shape=(48, 64))
    picture = _shown(LensMaterial(-3.0), camera=camera)
    return f"finite, {int((picture.lens >= 0).sum())} pixels of lens"


@CASES.extreme(STAGE, "picture of 1 x 1")
def _dot() -> str:
    picture = _shown(LensMaterial(-3.0), shape=(1, 1))
    return f"{picture.image_linear.shape}, finite"


@CASES.extreme(STAGE, "picture under black light", slow=True)
def _night() -> str:
    picture = _shown(LensMaterial(-3.0), lights=DistantLights([[0, 0, 1]], [0.0]))
    assert not picture.image_linear.any()
    return "black"


@CASES.extreme(STAGE, "picture under light of 1e12", slow=True)
def _glare() -> str:
    bright, plain = (
        _shown(LensMaterial(-3.0), lights=DistantLights([[0, 0, 1]], [s])).image_linear for s in (1e12, 1.0)
    )
    off = float(np.abs(bright / 1e12 - plain).max())
    assert off < 1e-9
    return f"linear within {off:.0e}"


@CASES.extreme(STAGE, "rim sought far from the frame", "named error")
@naming("no closed rim")
def _no_rim() -> str:
    frame = _frame()
    return str(
        find_lens_rim(frame.vertices, frame.faces, frame.lens_centers[0] + [0, 0, 500.0], normal=[0, 0, 1])
    )


for _name, _outline in (
    ("of two points", np.array([[0.0, 0, 0], [10, 0, 0]])),
    ("collapsed to a point", np.ones((8, 3))),
    ("with NaN", np.full((8, 3), math.nan)),
):

    @CASES.extreme(STAGE, f"lens mesh in a rim {_name}", "named error")
    def _odd_rim(outline: FloatArray = _outline) -> str:
        return str(lens_mesh([0, 0, 0], outline)[0].shape)
