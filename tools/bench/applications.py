"""Errors of applications: relit textures, expressions given to others, swaps, blends, exported textures.

`relight`: textures under ten new lights beside an independent renderer, albedo true and estimated.
`expression`: expressions of measured and synthetic faces, given to another; mm by which measured points miss
their true places, with nothing carried, as fitted with the model and from A at rest, refined, and with A's
true displacement. `people`: how far apart fits of one person, and of two, are where they are still; "taken
for two" is the share above the limit. `swap` and `blend`: real and path-traced faces with each other's skin,
and half way between two: features of which a part is one face's and a part the other's ("mixed"), edges that
neither face has, and the skin's tint beside that of who gave the shape. `features`: how well the features of
two faces lie on one another before a blend and as it moves them: overlap of labels (Dice), correlation of the
local contrast of log V, edges of neither face as it was moved. `rims`: texels beside the charts of exported
textures, up to 8 away, from the nearest one inside: sRGB, 0 to 1. `environment`: real faces under environment
maps by few lights, beside 8,192 drawn by brightness: rms error, and the worst of 100, in percent.
`--pictures` gets swaps, blends and faces under environment maps.
"""

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import distance_transform_edt, maximum_filter
from worlds.environments import ENVIRONMENTS, reference_lights
from worlds.files import face_data
from worlds.fits import fitted_face
from worlds.light_stage import FACE_VERTICES, LightStage

import scan2albedo as s2a
from bench.judging import picture_errors
from bench.runner import Bench, Case
from scan2albedo.applications import (
    FaceMesh,
    ProcessedFace,
    TransferOptions,
    blend_faces,
    load_result,
    personal_model,
    relight,
    swap_texture,
    write_face,
)
from scan2albedo.applications.blending import matched_skins
from scan2albedo.applications.expression_transfer import (
    TWO_PEOPLE_MM,
    apart_where_still,
    expression_displacement,
)
from scan2albedo.applications.files import PORTRAIT_LIGHT
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.rasterization import rasterize_uv
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.geometry_image_files import read_geometry_image
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.pipeline.process import write_result
from scan2albedo.synthetic import Material, SyntheticScene, face, light_at
from scan2albedo.synthetic.face_shape import person
from scan2albedo.synthetic.renderer import RayScene, render
from scan2albedo.unlit.face_features import FEATURES as LABELS, local_contrast, texels_of_parts, warped

LIGHTS = [
    light_at(0, 0),
    light_at(30, 20),
    light_at(-45, 10, intensity=2),
    light_at(60, -20, intensity=4),
    light_at(-75, 30, intensity=5),
    light_at(15, 60),
    light_at(0, -40, intensity=2),
    light_at(40, 30, distance_mm=450),
    light_at(-60, 0, distance_mm=350, intensity=4),
    light_at(85, 45, intensity=6),
]
NOISE_MM = 0.15
GENERIC = "generic_neutral"
MOVES = (
    (GENERIC, "smile", "person2"),
    (GENERIC, "left smile", "person2"),
    (GENERIC, "jaw", "person2"),
    (GENERIC, "left smile and jaw", "person1"),
    (GENERIC, "brows and jaw", "person1"),
    ("person1", "smile", "person2"),
    ("person2", "smile", "person1"),
    ("person4", "jaw", GENERIC),
    ("person3", "brows and jaw", "person4"),
)
"""Who makes which face, and to whom it is given."""
SIDE_MM = 6.0
"""Over this width from the middle a one-sided smile fades out."""
SYNTHETIC = ("smile", "frown", "pout", "surprise")
NEAR_MM = 2.0
"""Vertices farther than this from the fitted face at rest do not belong to it."""
FILES = {
    "james": "james.obj",
    "fran": "fran.obj",
    **{name: f"traced/{name}.obj" for name in ("p105_front", "p106_gloss", "p108_smile_m")},
    **{
        name: f"real_skin/{name}.obj"
        for name in ("d_emily_pods", "d_dome", "d_two_colours", "d_window_lamp", "d_studio3", "d_sun_sky")
    },
}
PAIRS = (
    ("james", "fran"),
    ("james", "p105_front"),
    ("p106_gloss", "p108_smile_m"),
    ("james", "d_emily_pods"),
    ("fran", "d_dome"),
    ("d_two_colours", "d_window_lamp"),
    ("james", "d_two_colours"),
    ("d_studio3", "d_sun_sky"),
    ("d_studio3", "fran"),
    ("james", "d_sun_sky"),
    ("d_emily_pods", "d_window_lamp"),
)
"""Of real and path-traced faces, some with shut eyes."""
PARTS = {
    "left eye": ("left_eye",),
    "right eye": ("right_eye",),
    "left brow": ("left_brow",),
    "right brow": ("right_brow",),
    "mouth": ("upper_lip", "lower_lip", "between_lips"),
}
"""Regions of the default model's chart by feature."""
SKIN = ("left_cheek", "right_cheek", "forehead")
TELLS = 0.02
"""Difference of two faces' gradients of the channels' logarithms from which a texel tells whose it is."""
MIXED = 0.1
"""From this part of a feature's texels on of either face it is a mixture."""
INVENTED = 0.1
"""Gradient of the channels' logarithms beyond both faces' that counts as an edge of neither."""
PIXELS = 400
"""On a side of a picture."""
LIGHT_PIXELS = 240
"""On a side of pictures that are compared with thousands of lights."""
LIMIT = 0.05
"""Of differences in sRGB, 0 to 1: what filtering may mix in at a chart's rim."""
BESIDE = 8
"""Texels beside a chart that filtering reads: one of a picture (mipmap) an eighth as large."""


def glossy_scene(seed: int, gloss: float) -> SyntheticScene:
    return face(seed, size=128, material=Material(0.3, gloss, 20.0), lights=[light_at(30, 15)])


def with_true_albedo(scene: SyntheticScene) -> tuple[ProcessedFace, float]:
    """Return the face, and what its colours are to be multiplied by."""
    material = scene.material
    skin = Reflectance(
        "oren-nayar", material.sigma_rad, material.specular_strength, material.specular_exponent
    )
    return ProcessedFace.of("true", scene.image, scene.albedo_linear, reflectance=skin), 1.0


def estimated(scene: SyntheticScene) -> tuple[ProcessedFace, float]:
    found = s2a.estimate_albedo(scene.image)
    face = ProcessedFace.of("estimated", scene.image, found.albedo_linear, reflectance=found.reflectance)
    return face, 1 / scene.gain


def relit_errors(scene: SyntheticScene, answer: tuple[ProcessedFace, float]) -> dict[str, float]:
    image = scene.image
    mask = image.mask
    occluder = RayScene(*image.occluder_mesh())
    errors = []
    for light in LIGHTS:
        truth = render(
            image.position[mask],
            image.normal[mask],
            scene.albedo_linear[mask],
            [light],
            material=scene.material,
            occluder=occluder,
            specular_scale=image.specular_scale[mask],
        ).radiance_linear
        relit = answer[1] * relight(answer[0], [light]).texture_linear[mask]
        errors.append(100 * np.linalg.norm(relit - truth) / np.linalg.norm(truth))
    return {"RMSE %": float(np.mean(errors)), "worst light %": float(np.max(errors))}


@dataclass(frozen=True)
class Pair:
    """Vertices of A at rest and with the expression, of B, and of B with the same: (V, 3) mm each.

    `inner` of them are measured, the same index being the same point; `faces` (F, 3) are all of theirs.
    """

    a: FloatArray
    moving: FloatArray
    b: FloatArray
    truth: FloatArray
    faces: IntArray
    inner: int
    model: s2a.AnnotatedFaceModel


@cache
def measured_moves() -> dict[str, FloatArray]:
    """Return displacements (V, 3) mm of light-stage expressions, which add to any of the shapes."""
    people = LightStage.load()
    rest = people.shapes[GENERIC]
    with np.load(face_data("ict_faces.npz")) as data:
        jaw = data["shape_generic_jawOpen0.7"] - rest
        brows = data["shape_person3_browInnerUp_L_browInnerUp_R_jawOpen0.5"] - people.shapes["person3"]
    left = people.smile / (1 + np.exp(-rest[:, :1] / SIDE_MM))
    return {
        "smile": people.smile,
        "jaw": jaw,
        "left smile": left,
        "left smile and jaw": left + 0.4 * jaw,
        "brows and jaw": brows,
    }


@cache
def generic_model() -> s2a.AnnotatedFaceModel:
    people = LightStage.load()
    return s2a.AnnotatedFaceModel.from_mesh(
        people.shapes[GENERIC], people.face_area, landmarks=people.landmarks, name="generic face"
    )


def measured_pair(a: str, move: str, b: str, own_model: bool) -> Pair:
    people = LightStage.load()
    shapes = [people.shapes[name] + by for name in (a, b) for by in (0.0, measured_moves()[move])]
    model = generic_model() if own_model else s2a.AnnotatedFaceModel.default()
    return Pair(*shapes, people.faces, FACE_VERTICES, model)


def synthetic_pair(expression: str) -> Pair:
    """Return a pair of synthetic people, whose skin has no features but those of the default model."""
    model = s2a.AnnotatedFaceModel.default()
    surface = model.subdivision(2)

    def shape(seed: int, expression: str) -> FloatArray:
        return surface.matrix @ person(model, np.random.default_rng(seed), expression=expression)

    shapes = [shape(seed, name) for seed in (1, 2) for name in ("neutral", expression)]
    return Pair(*shapes, surface.faces, len(shapes[0]), model)


def expressions(quick: bool) -> Iterator[Case]:
    for own_model in (False, True):
        group = "generic model" if own_model else "default model"
        for a, move, b in MOVES[: 1 if quick else None]:
            yield Case(f"{a} {move} to {b}", partial(measured_pair, a, move, b, own_model), group)
    for expression in SYNTHETIC[: 0 if quick else None]:
        yield Case(f"synthetic {expression}", partial(synthetic_pair, expression), "default model")


def fitted(vertices: FloatArray, faces: IntArray, model: s2a.AnnotatedFaceModel) -> FittedFace:
    return fitted_face(s2a.RawScan(vertices, faces), model)


def mesh_of(face: FittedFace) -> FaceMesh:
    return FaceMesh(face.vertices, face.faces, face.uv)


def carried(pair: Pair, correspondence: str, from_rest: bool = False) -> FloatArray:
    """Return the displacement (V, 3) of the model's vertices from A's fits."""
    a = fitted(pair.a, pair.faces, pair.model)
    moving = fitted(pair.moving, pair.faces, personal_model(a) if from_rest else pair.model)
    options = TransferOptions(correspondence=correspondence)
    return expression_displacement(mesh_of(a), mesh_of(moving), options=options, model=pair.model)


def true_displacement(pair: Pair) -> FloatArray:
    """Return (V, 3) by which the points of A that the fit at rest found truly move."""
    a = fitted(pair.a, pair.faces, pair.model)
    rest, moving = (transform_points(a.model_from_scan, points) for points in (pair.a, pair.moving))
    return surface_query(rest, pair.faces).query(a.vertices).interpolated(moving - rest, pair.faces)


def carried_errors(pair: Pair, moved: FloatArray | None) -> dict[str, float]:
    """Return by how much measured points carried with B's fitted face miss their true places, mm."""
    b = fitted(pair.b, pair.faces, pair.model)
    moved = np.zeros_like(b.vertices) if moved is None else moved
    rest, truth = (
        transform_points(b.model_from_scan, points[: pair.inner]) for points in (pair.b, pair.truth)
    )
    hits = surface_query(b.vertices, b.faces).query(rest)
    off = np.linalg.norm(hits.points + hits.interpolated(moved, b.faces) - truth, axis=1)
    off = off[hits.distance < NEAR_MM]
    return {"mean mm": float(off.mean()), "median mm": float(np.median(off))}


@cache
def noisy_fit(name: str, move: str) -> FaceMesh:
    people = LightStage.load()
    moves = measured_moves() | people.expressions
    shape = people.shapes[name] + (moves[move] if move else 0.0)
    rng = np.random.default_rng([*f"{name} {move}".encode()])
    noisy = shape + rng.normal(0, NOISE_MM, shape.shape)
    return mesh_of(fitted(noisy, people.faces, s2a.AnnotatedFaceModel.default()))


def still_faces(quick: bool) -> Iterator[Case]:
    moves = ("", "smile", "jaw", "brows and jaw", "cheek_puff", "nose_sneer")
    people = list(LightStage.load().shapes)
    for name in ("person1", "person2", "person4")[: 1 if quick else None]:
        for move in moves[:2] if quick else moves:
            for other in people[1:3] if quick else people:
                group = "one person" if other == name else "two people"
                made = (partial(noisy_fit, other, ""), partial(noisy_fit, name, move))
                yield Case(
                    f"{other} and {name} {move}", lambda made=made: tuple(make() for make in made), group
                )


@cache
def results() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="faces")


@cache
def real_face(name: str) -> ProcessedFace:
    folder = Path(results().name)
    write_result(s2a.process(face_data(FILES[name]), seed=0, unlit="face"), folder)
    return load_result(folder / name)


def pairs(both_ways: bool, quick: bool) -> Iterator[Case]:
    for first, second in PAIRS[: 1 if quick else None]:
        for a, b in ((first, second), (second, first))[: 2 if both_ways else 1]:
            name = f"{a} with the skin of {b}" if both_ways else f"{a} and {b}"
            yield Case(name, lambda a=a, b=b: (real_face(a), real_face(b)))


def region_texels(face: ProcessedFace, names: Sequence[str]) -> BoolArray:
    regions = s2a.AnnotatedFaceModel.default().regions
    return np.isin(face.image.region, [regions[name].index for name in names])


def slopes(face: ProcessedFace) -> FloatArray:
    """Return (H, W, 6) the gradient of each channel's logarithm over root three; a texel beside none has 0.

    Its norm is the rms of the channels. A tint, which is one factor a channel, makes no edge.
    """
    value = np.log(np.maximum(face.albedo_linear, 1e-3 * max(face.level(), 1e-9))) / np.sqrt(3)
    found = np.zeros((2, *value.shape))
    mask = face.mask[..., None]
    found[0, :, :-1] = np.diff(value, axis=1) * (mask[:, 1:] & mask[:, :-1])
    found[1, :-1] = np.diff(value, axis=0) * (mask[1:] & mask[:-1])
    return np.concatenate(list(found), -1)


def invented_percent(a: ProcessedFace, b: ProcessedFace, made: ProcessedFace) -> float:
    """Return the percentage of texels with an edge that neither face has."""
    of_a, of_b, of_made = (np.linalg.norm(slopes(face), axis=-1) for face in (a, b, made))
    inner = made.mask & ~made.image.border
    return 100 * float(np.mean((of_made > np.maximum(of_a, of_b) + INVENTED)[inner]))


def skin_tint(face: ProcessedFace) -> FloatArray:
    """Return the skin's median log R/G and log B/G."""
    skin = region_texels(face, SKIN) & face.mask
    red, green, blue = np.log(np.maximum(np.median(face.albedo_linear[skin], axis=0), 1e-6))
    return np.array([red - green, blue - green])


def seams(scene: tuple[ProcessedFace, ProcessedFace], made: ProcessedFace) -> dict[str, float | str]:
    """Return how well the albedo of two faces became one."""
    a, b = scene
    of_a, of_b, of_made = (slopes(face) for face in (a, b, made))
    to_a = np.linalg.norm(of_made - of_a, axis=-1)
    to_b = np.linalg.norm(of_made - of_b, axis=-1)
    apart = np.linalg.norm(of_a - of_b, axis=-1)
    tells = (apart > TELLS) & (np.minimum(to_a, to_b) < apart / 3) & made.mask
    mixed = []
    for name, regions in PARTS.items():
        there = region_texels(a, regions) & tells
        share = float(np.mean((to_b < to_a)[there])) if there.any() else 0.0
        if MIXED < share < 1 - MIXED:
            mixed.append(f"{name} ({100 * share:.0f} % of B)")
    return {
        "edges %": invented_percent(a, b, made),
        "tint": float(np.linalg.norm(skin_tint(made) - skin_tint(a))),
        "mixed": float(len(mixed)),
        "features": ", ".join([*mixed, *(note.split(":")[0] for note in made.notes)]),
    }


def features(scene: tuple[ProcessedFace, ProcessedFace], made: ProcessedFace) -> dict[str, float]:
    """Return how well the features of two faces lie on one another, as they are and as a blend moves them."""
    a, b = scene
    skins, beside = matched_skins(a, b, 0.5)
    flows = (-beside / 2, beside / 2)
    moved_skins = [warped(skin, flow) for skin, flow in zip(skins, flows, strict=True)]
    shown = [local_contrast(skin, a.mask & b.mask) for skin in (*skins, *moved_skins)]
    row: dict[str, float] = {}
    for name, (label, *_) in LABELS.items():
        own = [texels_of_parts(face, [label]) for face in (a, b)]
        moved = [warped(t.astype(float), flow) > 0.5 for t, flow in zip(own, flows, strict=True)]
        around = np.logical_or.reduce([*own, *moved])
        if own[0].any() and own[1].any():
            for when, (t, s), pictures in (("before", own, shown[:2]), ("after", moved, shown[2:])):
                row[f"{name} {when}"] = float(2 * np.sum(t & s) / (t.sum() + s.sum()))
                row[f"{name} agrees {when}"] = float(np.corrcoef(*(p[around] for p in pictures))[0, 1])
    faces = [
        replace(face, albedo_linear=np.maximum(warped(face.albedo_linear.astype(float), flow), 0))
        for face, flow in zip(scene, flows, strict=True)
    ]
    row["edges as moved %"] = invented_percent(*faces, made)
    return row


def portraits(scene: Sequence[ProcessedFace], made: Mapping[str, ProcessedFace]) -> NDArray[np.uint8]:
    """Return pictures of both faces and what was made of them, side by side."""
    faces = [*scene, *made.values()]
    return np.hstack([relight(f, (PORTRAIT_LIGHT,)).picture(shape=(PIXELS, PIXELS)).srgb() for f in faces])


def rim_step(picture: NDArray[np.integer], covered: BoolArray) -> float:
    """Return the largest difference (sRGB, 0 to 1) of texels beside the charts from the nearest one inside.

    `picture` (H, W, C), `covered` (H, W).
    """
    beside = maximum_filter(covered, 2 * BESIDE + 1) & ~covered
    row, column = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    step = np.abs(picture.astype(float) - picture[row, column])[beside]
    return float(step.max(initial=0.0)) / np.iinfo(picture.dtype).max


def exported_textures(folder: Path) -> Iterator[tuple[str, NDArray[np.integer], BoolArray]]:
    """Yield name, picture (H, W, C) and covered texels (H, W) of each texture in the folder of a result."""
    image = read_geometry_image(folder / "geometry_image.npz")
    yield "albedo.png", np.asarray(Image.open(folder / "albedo.png"))[..., :3], image.mask
    for file in sorted(folder.glob("*.glb")):
        scene = trimesh.load(file, process=False)
        parts = getattr(scene, "geometry", {"": scene})
        for name, mesh in parts.items():
            # Coordinates of a template's tiles beyond the first go on from tile to tile.
            uv = np.asarray(mesh.visual.uv)
            material = mesh.visual.material
            for kind, picture in (("", material.baseColorTexture), (" normals", material.normalTexture)):
                if picture is not None:
                    values = np.asarray(picture.convert("RGB"))
                    covered = rasterize_uv(uv - np.floor(uv.mean(0)), mesh.faces, values.shape[:2]).covered
                    yield f"{file.name}{' ' + name if len(parts) > 1 else ''}{kind}", values, covered


def exported(make: Callable[..., ProcessedFace] | None, a: str, b: str) -> Path:
    """Return the folder of a result: of one face, or of what is made of two."""
    faces = [real_face(name) for name in (a, b)]
    if make is None:
        return Path(results().name) / a
    folder = Path(results().name) / f"{make.__name__}_{a}_{b}"
    return write_face(make(*faces), folder, application="bench", inputs=faces)


def exports(quick: bool) -> Iterator[Case]:
    for a, b in PAIRS[: 1 if quick else None]:
        yield Case(a, partial(exported, None, a, b))
        yield Case(f"swap {a} {b}", partial(exported, swap_texture, a, b))
        yield Case(f"blend {a} {b}", partial(exported, blend_faces, a, b))


def rim_steps(folder: Path) -> dict[str, float]:
    return {name: rim_step(picture, covered) for name, picture, covered in exported_textures(folder)}


def under_maps(quick: bool) -> Iterator[Case]:
    for name in ("james",) if quick else ("james", "p105_front"):
        for place, make in ENVIRONMENTS.items():
            yield Case(f"{name}, {place}", lambda name=name, make=make: (real_face(name), make()))


def by_lights(scene: tuple[ProcessedFace, FloatArray], spread: str, count: int) -> Any:
    lights = DistantLights.from_environment(scene[1], count, spread)
    relit = relight(scene[0], environment_linear=lights)
    return relit.picture(shape=(LIGHT_PIXELS, LIGHT_PIXELS), samples=1)


def beside_many_lights(scene: tuple[ProcessedFace, FloatArray], made: Any) -> dict[str, float]:
    many = relight(scene[0], environment_linear=reference_lights(scene[1]))
    truth = many.picture(shape=(LIGHT_PIXELS, LIGHT_PIXELS), samples=1)
    parts = [picture.linear[truth.alpha > 0][None].astype(float) for picture in (made, truth)]
    rms, worst = picture_errors(*parts)
    return {"rms %": 100 * rms, "worst %": 100 * worst}


BLEND = {"blend": lambda scene: blend_faces(*scene, 0.5)}
BENCHES = {
    "relight": Bench(
        lambda quick: (
            Case(f"person {seed}, gloss {gloss}", partial(glossy_scene, seed, gloss))
            for seed in range(1 if quick else 3)
            for gloss in (0.0, 0.15)
        ),
        methods={"true albedo": with_true_albedo, "estimated": estimated},
        score=relit_errors,
    ),
    "expression": Bench(
        expressions,
        methods={
            "refined": partial(carried, correspondence="refined"),
            "as fitted": partial(carried, correspondence="as-fitted"),
            "as fitted from rest": partial(carried, correspondence="as-fitted", from_rest=True),
            "true displacement": true_displacement,
            "none": lambda pair: None,
        },
        score=carried_errors,
        summaries=("mean",),
    ),
    "people": Bench(
        still_faces,
        methods={"scan2albedo": lambda meshes: apart_where_still(*meshes)},
        score=lambda meshes, mm: {"mm": mm, "taken for two %": 100.0 * (mm > TWO_PEOPLE_MM)},
        summaries=("least", "median", "mean", "worst"),
    ),
    "swap": Bench(
        partial(pairs, True), {"swap": lambda scene: swap_texture(*scene)}, seams, picture=portraits
    ),
    "blend": Bench(partial(pairs, False), BLEND, seams, picture=portraits),
    "features": Bench(partial(pairs, False), BLEND, features, summaries=("mean",)),
    "rims": Bench(exports, {"scan2albedo": rim_steps}, lambda folder, steps: steps, summaries=("worst",)),
    "environment": Bench(
        under_maps,
        methods={
            f"{count} {spread}": partial(by_lights, spread=spread, count=count)
            for spread in ("even", "important")
            for count in (128, 256)
        },
        score=beside_many_lights,
        picture=lambda scene, made: np.hstack([picture.srgb() for picture in made.values()]),
    ),
}
