"""Swaps, blends and relit pictures of scans of real people, as sheets to look at, with figures of seams."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from bench.judging import picture_errors as errors
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from worlds.environments import ENVIRONMENTS, reference_lights
from worlds.files import face_data

import scan2albedo as s2a
from scan2albedo import AnnotatedFaceModel
from scan2albedo.applications import (
    ProcessedFace,
    blend_faces,
    default_camera,
    load_result,
    relight,
    swap_texture,
)
from scan2albedo.applications.blending import matched_skins
from scan2albedo.applications.face_features import FEATURES as LABELS
from scan2albedo.applications.face_features import local_contrast, named_texels, warped
from scan2albedo.applications.files import PORTRAIT_LIGHT
from scan2albedo.core import PointLight
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.core.lights import LAMP_RADIUS_DEG
from scan2albedo.lighting.environment import DistantLights, LightSpread
from scan2albedo.pipeline.result import write_result

SCANS = {
    "james": "james.obj",
    "fran": "fran.obj",
    "p105_front": "traced/p105_front.obj",
    "p106_gloss": "traced/p106_gloss.obj",
    "p108_smile_m": "traced/p108_smile_m.obj",
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
)
SEAM_PAIRS = (
    *(pair for pair in PAIRS if not pair[1].startswith("p10")),
    ("d_studio3", "d_sun_sky"),
    ("d_studio3", "fran"),
    ("james", "d_sun_sky"),
    ("d_emily_pods", "d_window_lamp"),
)
"""Of real faces, some with shut eyes."""
FEATURES = {
    "left eye": ("left_eye",),
    "right eye": ("right_eye",),
    "left brow": ("left_brow",),
    "right brow": ("right_brow",),
    "mouth": ("upper_lip", "lower_lip", "between_lips"),
}
LAMPS = {"left": (60.0, 10.0), "right": (-60.0, 10.0), "above": (10.0, 60.0)}
"""Azimuth and elevation in degrees, from the front toward the subject's left and up."""
_SIZE, _CLOSE = 400, 2.4
"""Pixels on a side of each picture, and by how much eyes and mouth are enlarged."""
_FEW_LIGHTS: tuple[tuple[LightSpread, int], ...] = (
    ("even", 128),
    ("even", 256),
    ("important", 128),
    ("important", 256),
)
_MANY_LIGHTS = 240
"""Pixels on a side of pictures that are compared with thousands of lights."""
_TELLS = 0.02
"""Difference of two faces' gradients of the channels' logarithms from which a texel tells whose it is."""
_MIXED = 0.1
"""From this part of a feature's texels on of either face it is a mixture."""
_INVENTED = 0.1
"""Gradient of the channels' logarithms beyond both faces' that counts as an edge of neither."""

Pixels = NDArray[np.uint8]


def real_faces(results: Path, names: Sequence[str]) -> dict[str, ProcessedFace]:
    """Return processed scans by name; those whose folder is not in `results` yet are processed first."""
    faces = {}
    for name in names:
        folder = results / name
        if not (folder / "result.json").is_file():
            print(f"{name}: is processed first", flush=True)
            write_result(s2a.process(face_data(SCANS[name]), seed=0, unlit="face"), results)
        faces[name] = load_result(folder)
    return faces


@dataclass(frozen=True)
class SeamFigures:
    """How well the albedo of two faces became one."""

    mixed: tuple[str, ...]
    """Features of which a part is one face's and a part the other's."""
    invented: float
    """Percentage of texels with an edge that neither face has."""
    tint: float
    """Between the skin's median log R/G and log B/G of the result and those of who gave the shape."""

    def __str__(self) -> str:
        return (
            f"mixed features: {', '.join(self.mixed) or 'none'}; "
            f"edges of neither face: {self.invented:.2f} %; tint off by {self.tint:.3f}"
        )


def seam_figures(a: ProcessedFace, b: ProcessedFace, made: ProcessedFace) -> SeamFigures:
    """Return the figures of a face made of A's shape and B's skin."""
    slopes = [_slopes(face) for face in (a, b, made)]
    to_a, to_b = (np.linalg.norm(slopes[2] - slope, axis=-1) for slope in slopes[:2])
    apart = np.linalg.norm(slopes[0] - slopes[1], axis=-1)
    tells = (apart > _TELLS) & (np.minimum(to_a, to_b) < apart / 3) & made.mask
    mixed = []
    for name, texels in feature_texels(a).items():
        there = texels & tells
        share = float(np.mean((to_b < to_a)[there])) if there.any() else 0.0
        if _MIXED < share < 1 - _MIXED:
            mixed.append(f"{name} ({100 * share:.0f} % of B)")
    size = [np.linalg.norm(slope, axis=-1) for slope in slopes]
    inner = made.mask & ~made.image.border
    invented = size[2] > np.maximum(size[0], size[1]) + _INVENTED
    tint = float(np.linalg.norm(_skin_tint(made) - _skin_tint(a)))
    return SeamFigures(tuple(mixed), 100 * float(np.mean(invented[inner])), tint)


def feature_texels(face: ProcessedFace) -> dict[str, BoolArray]:
    """Return the (H, W) texels of each of `FEATURES` on the default model's chart."""
    return {name: _region_texels(face, parts) for name, parts in FEATURES.items()}


def _region_texels(face: ProcessedFace, names: Sequence[str]) -> BoolArray:
    assert face.image.region is not None
    regions = AnnotatedFaceModel.default().regions
    return np.isin(face.image.region, [regions[name].index for name in names])


def _slopes(face: ProcessedFace) -> FloatArray:
    """Return (H, W, 6) the gradient of each channel's logarithm over root three, so that a norm is the rms of
    the channels; a texel beside none has 0.

    A tint, which is one factor a channel, makes no edge.
    """
    value = np.log(np.maximum(face.albedo_linear, 1e-3 * max(face.level(), 1e-9))) / np.sqrt(3)
    slopes, mask = np.zeros((2, *value.shape)), face.mask[..., None]
    slopes[0, :, :-1] = np.diff(value, axis=1) * (mask[:, 1:] & mask[:, :-1])
    slopes[1, :-1] = np.diff(value, axis=0) * (mask[1:] & mask[:-1])
    return np.concatenate(list(slopes), -1)


def _skin_tint(face: ProcessedFace) -> FloatArray:
    cheeks = _region_texels(face, ("left_cheek", "right_cheek", "forehead"))
    red, green, blue = np.log(np.maximum(np.median(face.albedo_linear[cheeks & face.mask], axis=0), 1e-6))
    return np.array([red - green, blue - green])


def portrait(face: ProcessedFace, lights: Sequence[PointLight] = (PORTRAIT_LIGHT,)) -> Pixels:
    """Return the picture of a face, with eyes and mouth enlarged below it."""
    relit = relight(face, lights)
    whole = relit.picture(shape=(_SIZE, _SIZE))
    exposure, parts = whole.auto_exposure(), [whole.srgb()]
    for features, height in ((("left eye", "right eye"), 0.4), (("mouth",), 0.4)):
        texels = np.logical_or.reduce([feature_texels(face)[name] for name in features]) & face.mask
        camera = default_camera(face, (_SIZE, _SIZE))
        middle = camera @ np.append(face.image.position[texels].mean(0), 1.0)
        at = middle[:2] / middle[2]
        closer = np.array(
            [[_CLOSE, 0, _SIZE / 2 - _CLOSE * at[0]], [0, _CLOSE, height * _SIZE / 2 - _CLOSE * at[1]]]
        )
        camera = np.vstack([closer, [0, 0, 1]]) @ camera
        parts.append(relit.picture(camera, shape=(int(height * _SIZE), _SIZE)).srgb(exposure))
    return np.vstack(parts)


def write_sheet(file: Path, rows: Sequence[Sequence[tuple[str, Pixels]]]) -> None:
    """Write rows of titled pictures of one size as a PNG."""
    height, width = rows[0][0][1].shape[:2]
    sheet = Image.new("RGB", (max(map(len, rows)) * width, len(rows) * (height + 18)), "white")
    drawing = ImageDraw.Draw(sheet)
    for i, row in enumerate(rows):
        for j, (title, picture) in enumerate(row):
            drawing.text((j * width + 4, i * (height + 18) + 3), title, fill="black")
            sheet.paste(Image.fromarray(picture), (j * width, i * (height + 18) + 18))
    sheet.save(file)
    print(f"{file}: {sheet.width} x {sheet.height}", flush=True)


def bench_swap(results: Path, out: Path, pairs: Sequence[tuple[str, str]] | None) -> None:
    """Print the figures of swaps between real faces, and write swap.png."""
    pairs = pairs or PAIRS
    faces, rows = real_faces(results, _names(pairs)), []
    for first, second in pairs:
        row = [(name, portrait(faces[name])) for name in (first, second)]
        for a, b in ((first, second), (second, first)):
            made = swap_texture(faces[a], faces[b])
            print(f"swap  {a} with the skin of {b}: {seam_figures(faces[a], faces[b], made)}", flush=True)
            row.append((f"{a} with the skin of {b}", portrait(made)))
        rows.append(row)
    write_sheet(out / "swap.png", rows)


def bench_blend(results: Path, out: Path, pairs: Sequence[tuple[str, str]] | None) -> None:
    """Print the figures of blends half way between real faces, and write blend.png."""
    pairs = pairs or PAIRS
    faces, rows = real_faces(results, _names(pairs)), []
    for first, second in pairs:
        a, b = faces[first], faces[second]
        made = blend_faces(a, b, 0.5)
        print(f"blend {first} and {second}: {blend_text(a, b, made)}", flush=True)
        rows.append([(first, portrait(a)), ("half way", portrait(made)), (second, portrait(b))])
    write_sheet(out / "blend.png", rows)


def bench_seams(results: Path, pairs: Sequence[tuple[str, str]] | None) -> None:
    """Print the edges that swaps and blends have and neither face has, and what their notes say.

    Of blends beside both faces as they are, and as their features were moved onto one another.
    """
    pairs = pairs or SEAM_PAIRS
    faces = real_faces(results, _names(pairs))
    print("edges of neither face, % of the texels: A with B's skin, B with A's, blend (as moved)")
    for first, second in pairs:
        a, b = faces[first], faces[second]
        half = blend_faces(a, b, 0.5)
        made = (
            (a, b, swap_texture(a, b)),
            (b, a, swap_texture(b, a)),
            (a, b, half),
            (*moved_faces(a, b), half),
        )
        row = "{:8.3f}{:8.3f}{:8.3f} ({:.3f})".format(*(seam_figures(*three).invented for three in made))
        said = "; ".join(note.split(":")[0] for note in half.notes)
        print(f"{f'{first}, {second}':32}{row}  {said}", flush=True)


def moved_faces(a: ProcessedFace, b: ProcessedFace) -> tuple[ProcessedFace, ProcessedFace]:
    """Return two faces with their features where a blend half way puts them."""
    _, beside = matched_skins(a, b, 0.5)
    return _warped(a, -beside / 2), _warped(b, beside / 2)


def _warped(face: ProcessedFace, flow: FloatArray) -> ProcessedFace:
    albedo = np.maximum(warped(face.albedo_linear.astype(np.float64), flow), 0)
    return replace(face, albedo_linear=albedo)


def blend_text(a: ProcessedFace, b: ProcessedFace, made: ProcessedFace) -> str:
    """Return how well the features of two faces lie on one another, as they are and as a blend moves them.

    Overlap of labels (Dice), which cover as much in both where nothing is twice; correlation of the local
    contrast of log V; edges of neither face where they were, and of neither as it was moved.
    """
    skins, beside = matched_skins(a, b, 0.5)
    flows, parts = (-beside / 2, beside / 2), []
    skins += [warped(skin, flow) for skin, flow in zip(skins, flows, strict=True)]
    shown = [local_contrast(skin, a.mask & b.mask) for skin in skins]
    for name, (label, *_) in LABELS.items():
        texels = [named_texels(face, [label]) for face in (a, b)]
        texels += [warped(t.astype(np.float64), f) > 0.5 for t, f in zip(texels, flows, strict=True)]
        around = texels[0] | texels[1] | texels[2] | texels[3]
        if texels[0].any() and texels[1].any():
            overlap = [2 * np.sum(t & s) / (t.sum() + s.sum()) for t, s in (texels[:2], texels[2:])]
            alike = [np.corrcoef(shown[i][around], shown[i + 1][around])[0, 1] for i in (0, 2)]
            parts.append(f"{name} {overlap[0]:.2f} to {overlap[1]:.2f} ({alike[0]:.2f} to {alike[1]:.2f})")
    return f"features overlap (and agree): {', '.join(parts)}"


def bench_relit(results: Path, out: Path, names: Sequence[str] = ("james", "fran")) -> None:
    """Write relit.png: real faces under one lamp from three directions."""
    rows = []
    for name, face in real_faces(results, names).items():
        row = [(f"{name}, as scanned", _as_scanned(face))]
        for where, (azimuth, elevation) in LAMPS.items():
            lamp = PointLight(
                np.deg2rad(azimuth), np.deg2rad(elevation), intensity=3.0, radius_deg=LAMP_RADIUS_DEG
            )
            row.append((f"lamp {where}", portrait(face, [lamp])))
        rows.append(row)
    write_sheet(out / "relit.png", rows)


def bench_environment(results: Path, out: Path, names: Sequence[str] = ("james", "p105_front")) -> None:
    """Print errors of lights that stand for environment maps, and CPU seconds; write environment.png."""
    rows, shape = [], (_MANY_LIGHTS, _MANY_LIGHTS)
    print(f"{'face, environment':24}{'lights':>15}{'rms error %':>13}{'worst of 100 %':>15}{'CPU s':>8}")
    for name, face in real_faces(results, names).items():
        for place, make in ENVIRONMENTS.items():
            environment = make()
            many = relight(face, environment_linear=reference_lights(environment))
            truth = many.picture(shape=shape, samples=1)
            exposure, row = truth.auto_exposure(), []
            for spread, count in _FEW_LIGHTS:
                cpu = time.process_time()
                lights = DistantLights.from_environment(environment, count, spread)
                relit = relight(face, environment_linear=lights)
                made = relit.picture(shape=shape, samples=1)
                cpu = time.process_time() - cpu
                parts = [
                    picture.linear[truth.alpha > 0][None].astype(np.float64) for picture in (made, truth)
                ]
                rms, worst = errors(*parts)
                title = f"{count} {spread}"
                print(
                    f"{f'{name}, {place}':24}{title:>15}{100 * rms:13.2f}{100 * worst:15.2f}{cpu:8.1f}",
                    flush=True,
                )
                row.append((f"{name}, {place}: {title}", made.srgb(exposure)))
            rows.append([*row, ("8192 drawn by brightness", truth.srgb(exposure))])
    write_sheet(out / "environment.png", rows)


def _as_scanned(face: ProcessedFace) -> Pixels:
    if face.environment is None:
        return portrait(face, face.lights)
    relit = relight(face, face.lights, environment=face.environment)
    picture = relit.picture(shape=(_SIZE, _SIZE)).srgb()
    blank = np.full((2 * int(0.4 * _SIZE), _SIZE, 3), 255, np.uint8)
    return np.vstack([picture, blank])


def _names(pairs: Sequence[tuple[str, str]]) -> list[str]:
    return list(dict.fromkeys(name for pair in pairs for name in pair))
