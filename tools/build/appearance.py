"""Learn what skin, brows, eyes, lips, nostrils and hair look like and where they are: `MaterialModel`.

The heads are sixteen of the VALID avatars (NOTICE), which share one layout of their texture: brows, lips,
eyes and nostrils are at known places there (`OUTLINES`), of a brow what is darker than the skin beside it.
Each head is registered, fitted and sampled, and shown LIGHTS times: under up to two coloured lamps with
shadows and an environment, with a beard painted on some, and a cap, a mask or a fringe on others.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter

import scan2albedo as s2a
from build import fitted_heads, output
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.face_model.materials import (
    CLASSES,
    TEXEL_MM,
    MaterialModel,
    chart_features,
    fit_light,
    light_basis,
)
from scan2albedo.geometry.rasterization import area_mean

SIZE = 256
"""Texels a side of the geometry images."""
CELLS = 128
"""Cells a side, in which classes and features are known."""
LIGHTS = 6
"""Times that each head is shown."""
SIDE = 1024
"""Of the heads' textures, in whose pixels OUTLINES are."""
OUTLINES: dict[str, list[list[list[int]]]] = json.loads(
    Path(__file__).with_name("valid_outlines.json").read_text(encoding="utf-8")
)
"""Polygons of each class, drawn by hand on the heads' textures."""
RIM = {"brow": 30, "eye": 16, "lip": 24, "nostril": 16}
"""Width of the line around an outline where the truth is not known."""
BROW_DARKER = (0.08, 0.2)
"""Log brightness below the skin's up to which a texel is skin, and from which it is a brow."""
HAIR_DARKER = (0.25, 0.9)
"""The same of hair."""
SHADE = 0.5
"""Part of the light that shadows leave below which skin counts as in shadow."""
BLUR = 1.5
"""Cells by which places err."""
LEAST_SHARE = {"hair": 0.02, "cloth": 0.01}
"""Shares of a class anywhere, else 0.002: sixteen heads do not show every place."""
NUMBER = {name: number for number, name in enumerate(CLASSES)}


@dataclass(frozen=True)
class Shown:
    """A head in one light, on (CELLS, CELLS): four `features`, `truth`, 0 where not known, and `shade`."""

    image: s2a.GeometryImage
    truth: NDArray[np.uint8]
    features: FloatArray
    shade: BoolArray


def truth_in_texture(linear: FloatArray) -> NDArray[np.uint8]:
    """Return the classes (SIDE, SIDE) of a head's texture (SIDE, SIDE, 3), 0 where they are not known."""

    def drawn(points: list[list[int]], width: int) -> BoolArray:
        corners = list(map(tuple, points))
        picture = Image.new("L", (SIDE, SIDE))
        draw = ImageDraw.Draw(picture)
        draw.polygon(corners, fill=1)
        draw.line([*corners, corners[0]], fill=1, width=max(width, 1), joint="curve")
        return np.asarray(picture) > 0

    bright = gaussian_filter(np.log(np.maximum(linear.max(-1), 1e-3)), 3)
    row, column = np.indices(bright.shape)
    beyond = ((column - 525) / 262) ** 2 + ((row - 440) / 290) ** 2 > 1
    skin = np.median(bright[380:440, 330:380])
    truth = np.full(bright.shape, NUMBER["skin"], np.uint8)
    truth[beyond & (bright < skin - HAIR_DARKER[0])] = 0
    truth[beyond & (row < 500) & (bright < skin - HAIR_DARKER[1])] = NUMBER["hair"]
    truth[beyond & (row > 690)] = 0
    for name, outlines in OUTLINES.items():
        for points in outlines:
            near, inside = drawn(points, RIM[name]), drawn(points, 0)
            if name == "brow":
                beside = np.percentile(bright[near], 85)
                truth[near] = 0
                truth[near & (bright > beside - BROW_DARKER[0])] = NUMBER["skin"]
                truth[near & (bright < beside - BROW_DARKER[1])] = NUMBER["brow"]
            else:
                truth[near] = 0
                truth[inside] = NUMBER[name]
    return truth


def heads() -> Iterator[tuple[s2a.GeometryImage, NDArray[np.uint8]]]:
    """Yield the image and the classes (SIZE, SIZE) of each head."""
    for _, scan, fitted in fitted_heads():
        assert scan.texture_linear is not None
        truth = truth_in_texture(scan.texture_linear.astype(float))
        planes = []
        for first in range(0, len(CLASSES), 3):
            three = np.stack([truth == first + k for k in range(3)], axis=-1).astype(np.float32)
            sampled = s2a.geometry_image(fitted, replace(scan, texture_linear=three), size=SIZE)
            planes.append(np.asarray(sampled.texture_linear))
        part = np.dstack(planes)[..., : len(CLASSES)]
        classes = np.where(part.max(-1) > 0.6, part.argmax(-1), 0).astype(np.uint8)
        yield s2a.geometry_image(fitted, scan, size=SIZE), classes


def painted(
    image: s2a.GeometryImage, truth: NDArray[np.uint8], rng: np.random.Generator
) -> tuple[FloatArray, NDArray[np.uint8]]:
    """Return a head's texture and classes with a beard, a cap or a mask, each now and then."""
    assert image.texture_linear is not None
    texture, truth = image.texture_linear.astype(float), truth.copy()
    row, column = (np.indices(truth.shape) + 0.5) / SIZE
    wave = gaussian_filter(rng.standard_normal(truth.shape), 12) * 12
    if rng.random() < 0.5:
        # From the sideburns along the jaw to the lip: as dense as stubble or as a full beard.
        jaw = (row > 0.62 + 0.25 * rng.random() + 0.02 * wave) | (np.abs(column - 0.5) > 0.42 + 0.02 * wave)
        lip = (row > 0.6 + 0.02 * wave) & (np.abs(column - 0.5) < 0.2) & (rng.random() < 0.7)
        where = (jaw & (row > 0.45) | lip) & (truth == NUMBER["skin"])
        strength, fine = rng.uniform(0.15, 1.2), rng.uniform(0.7, 1.5)
        strands = gaussian_filter(rng.standard_normal(truth.shape), (1.2 * fine, 0.6 * fine)) * 2.5 * fine
        hair = np.exp(-strength * np.clip(0.7 + strands, 0, 2))[..., None] * np.exp(rng.normal(0, 0.08, 3))
        texture[where] *= hair[where]
        truth[where] = NUMBER["beard"]
    if rng.random() < 0.4:
        edge = rng.uniform(0.05, 0.25) + 0.02 * wave
        where = row < edge if rng.random() < 0.7 else row > rng.uniform(0.5, 0.75) + 0.02 * wave
        weave = np.exp(rng.uniform(0, 0.15) * rng.standard_normal(truth.shape))
        texture[where] = (rng.uniform(0.01, 0.8) * np.exp(rng.normal(0, 0.5, 3)) * weave[..., None])[where]
        truth[where & image.mask] = NUMBER["cloth"]
    if rng.random() < 0.4:
        edge = rng.uniform(0.03, 0.15) + 0.03 * wave + 0.25 * np.abs(column - 0.5) * (rng.random() < 0.5)
        where = row < edge
        strands = gaussian_filter(rng.standard_normal(truth.shape), (3, 0.7)) * 5
        tone = rng.uniform(0.01, 0.25) * np.array([1.0, rng.uniform(0.55, 0.9), rng.uniform(0.3, 0.8)])
        texture[where] = (tone * np.exp(0.5 * strands)[..., None])[where]
        truth[where & image.mask] = NUMBER["hair"]
    return texture, truth


def lit(
    texture: FloatArray, normal: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, NDArray[np.float32]]:
    """Return a texture under an environment and up to two lamps with shadows, each of its own colour.

    And (SIZE, SIZE) the part of the light that the shadows leave.
    """
    light = (
        rng.uniform(0.1, 1)
        * np.exp(rng.normal(0, 0.12, 3))
        * (1 + 0.3 * rng.uniform(-1, 1) * normal[..., 1:2])
    )
    whole = light
    for _ in range(rng.integers(0, 3)):
        direction = rng.normal(0, 1, 3)
        direction[2] = abs(direction[2]) + 0.3
        cosine = np.maximum(normal @ (direction / np.linalg.norm(direction)), 0)
        strength = rng.uniform(0.3, 1.5) * np.exp(rng.normal(0, 0.12, 3))
        whole = whole + strength * cosine[..., None]
        if rng.random() < 0.6:
            field = gaussian_filter(rng.standard_normal(cosine.shape), 25) * 80
            cosine = cosine / (1 + np.exp(np.clip(rng.uniform(2, 20) * (field - rng.uniform(0, 2)), -30, 30)))
        light = light + strength * cosine[..., None]
    shown = texture * light
    left = (light / whole).max(-1).astype(np.float32)
    return np.asarray(0.8 * shown / np.percentile(shown, 99)), left


def shown(image: s2a.GeometryImage, truth: NDArray[np.uint8], rng: np.random.Generator) -> Shown:
    """Return a head in one light, its features by its true skin."""
    texture, now = painted(image, truth, rng)
    texture, left = lit(np.where(image.mask[..., None], texture, 0), image.normal, rng)
    seen = image.seen.astype(np.float32)
    part = area_mean(seen, (CELLS, CELLS)).astype(np.float32)
    mean = np.maximum(part, 1e-6)[..., None]
    color, normal = (
        (area_mean((field * seen[..., None]).astype(np.float32), (CELLS, CELLS)) / mean).astype(np.float32)
        for field in (texture, image.normal)
    )
    classes = np.stack(
        [area_mean((now == k).astype(np.float32), (CELLS, CELLS)) for k in range(len(CLASSES))], -1
    )
    cells = np.where((classes.max(-1) > 0.6) & (part > 0.5), classes.argmax(-1), 0).astype(np.uint8)
    skin = cells == NUMBER["skin"]
    colors, grain = chart_features(color, part, skin.astype(float), TEXEL_MM)
    start = np.median(colors[skin], axis=0)
    light = fit_light(light_basis(normal)[skin], colors[skin], np.full(skin.sum(), 1.0), start)
    relative = np.dstack([colors - light_basis(normal) @ light, grain])
    shade = area_mean(left, (CELLS, CELLS)) < SHADE
    return Shown(replace(image, texture_linear=texture.astype(np.float32)), cells, relative, shade)


def learn(shown_heads: list[Shown], plain: list[NDArray[np.uint8]]) -> MaterialModel:
    """Return the model of heads in several lights; `plain` (SIZE, SIZE) are their classes before painting."""
    of = {name: [one.truth == NUMBER[name] for one in shown_heads] for name in CLASSES[1:]}
    of["shade"] = [where & one.shade for where, one in zip(of["skin"], shown_heads, strict=True)]
    of["skin"] = [where & ~one.shade for where, one in zip(of["skin"], shown_heads, strict=True)]
    bright, shaded = (sum(int(where.sum()) for where in of[name]) for name in ("skin", "shade"))
    means, covariances = [], []
    for where in of.values():
        found = np.concatenate([one.features[w] for one, w in zip(shown_heads, where, strict=True)])
        mean = np.median(found, axis=0)
        off = np.clip(found - mean, -1.5, 1.5)
        means.append(mean)
        covariances.append(np.cov(off.T) + np.diag([0.03, 0.03, 0.03, 0.1]) ** 2)
    share = []
    for name in CLASSES[1:]:
        # Painted hair and beards show where they may be, of caps and masks only that they may be anywhere.
        many = name in ("beard", "hair", "cloth")
        seen = [one.truth for one in shown_heads] if many else plain
        maps = [area_mean((one == NUMBER[name]).astype(np.float32), (CELLS, CELLS)) for one in seen]
        mean_map = np.mean([side for one in maps for side in (one, one[:, ::-1])], axis=0)
        share.append(gaussian_filter(mean_map, BLUR * (2 if many else 1)) * (0.3 if many else 1.0))
    share[0] = np.maximum(share[0], 1 - sum(share))
    least = np.array([LEAST_SHARE.get(name, 0.002) for name in CLASSES[1:]])
    shares = np.array(share) / sum(share) + least[:, None, None]
    coarse = shares.reshape(len(shares), CELLS // 2, 2, CELLS // 2, 2).mean((2, 4))
    parts = np.array(means), np.array(covariances)
    return MaterialModel(coarse / coarse.sum(0), *parts, shaded / (bright + shaded))


def main(arguments: list[str]) -> None:
    """Sample, show, learn and write."""
    file = output(arguments, "face_model/data/appearance.npz")
    images, truths = zip(*heads(), strict=True)
    rng = np.random.default_rng(0)
    pairs = zip(images, truths, strict=True)
    model = learn([shown(*pair, rng) for pair in pairs for _ in range(LIGHTS)], list(truths))
    np.savez_compressed(
        file,
        share=model.share.astype(np.float16),
        mean=model.mean.astype(np.float32),
        covariance=model.covariance.astype(np.float32),
        shaded=model.shaded,
    )
    for name, mean, covariance in zip([*CLASSES[1:], "shade"], model.mean, model.covariance, strict=True):
        print(f"{name:8s}", mean.round(2), np.sqrt(np.diag(covariance)).round(2))
