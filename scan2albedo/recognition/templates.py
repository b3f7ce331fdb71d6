"""Templates: the coarsest scale of the complex steerable pyramid of an albedo, or of a surface's normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Integral
from typing import Final, Literal

import numpy as np
from scipy import fft
from scipy.ndimage import minimum_filter, uniform_filter
from skimage.morphology import isotropic_closing

from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    Float32Array,
    FloatArray,
    GridShape,
    NDArray,
    RealArray,
    Texts,
    Values,
    all_finite,
    attributes,
    finite_rows,
)
from scan2albedo.errors import RecognitionError, needs_extra
from scan2albedo.geometry.rasterization import area_mean, filled_from_nearest

Kind = Literal["albedo", "texture", "shape", "shading"]
"""What is compared: the albedo, the texture as photographed, the normals of the fitted surface; and texture
over albedo, which tells how alike the lights are, so how much of a texture's similarity is the light's."""
SCALES: Final = 3
ORIENTATIONS: Final = 10
"""`SCALES`, `ORIENTATIONS`: of the pyramid."""
STEP = 2 ** (SCALES - 1)
"""Pixels of the image between coefficients of the coarsest scale."""
HOLE_RADIUS = 0.024
"""Holes of the mask up to this radius, in sides of the image, are filled from around and count; otherwise a
hole that a scanner left would exclude every window that touches it."""
LEAST_WEIGHT = float(np.finfo(np.float32).eps)
"""Of what lies inside the mask, however uncertain: nothing is left of a pair otherwise."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear colour. The brightest channel of skin is red, which pigment and blood hardly darken; luminance
separates persons better (`python tools/bench templates/slips`)."""


class NothingToCompareError(RecognitionError):
    """An image without a single coefficient: masked (nearly) everywhere, or black."""


@dataclass(frozen=True, kw_only=True)
class TemplateOptions:
    """How an image becomes a template; `ValueError` for a size out of range."""

    size: int | None = 256
    """Longest side in pixels to which larger images are averaged down; smaller ones stay as they are, and
    with None all do."""
    unit_mean: bool = True
    """Divide by the mean over the mask, for an albedo is known up to a scale, and take the cube root
    (lightness, CIE 1976): light that is left scales contrasts, and in dim parts most of all."""

    def __post_init__(self) -> None:
        if self.size is not None and not (isinstance(self.size, Integral) and self.size >= 1):
            raise ValueError(f"size is {self.size!r}, expected a whole number >= 1 or None")


@dataclass(frozen=True)
class Chart:
    """The chart of a set of images."""

    model: str | None
    """Name of the face model; None where unknown."""
    shape: GridShape
    """Height and width in texels."""

    def __str__(self) -> str:
        size = f"{self.shape[1]} x {self.shape[0]} texels"
        return size if self.model is None else f"{size} of model {self.model!r}"


def common_chart(a: Chart | None, b: Chart | None, what_a: str, what_b: str) -> Chart | None:
    """Return the chart of two sets of images, with the model of either.

    RecognitionError when sizes or models differ; it names both sets and both charts.

    >>> common_chart(Chart(None, (256, 256)), Chart("mine", (256, 256)), "a", "b").model
    'mine'
    """
    if a is None or b is None:
        return b if a is None else a
    if a.shape != b.shape:
        raise RecognitionError(f"{what_a} has {a} and {what_b} {b}; process all scans with one --size")
    if None not in (a.model, b.model) and a.model != b.model:
        raise RecognitionError(
            f"{what_a} has {a} and {what_b} {b}, so their texels do not correspond; process all scans with "
            "one --model"
        )
    return a if b.model is None else b


@dataclass(frozen=True)
class Templates:
    """Templates of N images of one kind, and whose they are.

    Raises `ValueError` when shapes or numbers do not fit together, `RecognitionError` when a name is empty, a
    template not finite or masked everywhere; names it.
    """

    coefficients: NDArray[np.complex64]
    """(N, O, h, w): of O orientations, of one component after the other; 0 outside the mask. Components are
    the luminance of the albedo, or x, y and z of the normals."""
    mask: BoolArray
    """(N, h, w)."""
    names: Texts
    """(N,): of the persons; several templates may bear one name."""
    options: TemplateOptions = TemplateOptions()
    """How they were made."""
    chart: Chart | None = None
    """Of the images, where it is known; templates of different charts are not compared."""
    kind: Kind = "albedo"
    """Of what they are."""
    weight: Float32Array = None  # type: ignore[assignment]
    """(N, h, w): how certain the coefficients are, 0 to 1, above 0 inside the mask; 1 there when omitted."""

    def __post_init__(self) -> None:
        if self.weight is None:
            object.__setattr__(self, "weight", self.mask.astype(np.float32))
        coefficients, mask = self.coefficients, self.mask
        bands = ORIENTATIONS * (3 if self.kind == "shape" else 1)
        if coefficients.ndim != 4 or coefficients.shape[1] != bands:
            raise ValueError(
                f"{self.kind} coefficients have shape {coefficients.shape}, expected (N, {bands}, h, w)"
            )
        shape = coefficients.shape[:1] + coefficients.shape[2:]
        if not mask.shape == self.weight.shape == shape or len(mask) != len(self.names):
            raise ValueError(
                f"coefficients {coefficients.shape}, mask {mask.shape} and {len(self.names)} names do not "
                "fit: expected (N, O, h, w), (N, h, w) and N"
            )
        if coefficients.dtype != np.complex64 or mask.dtype != np.bool_:
            raise ValueError(f"got {coefficients.dtype} and {mask.dtype}, expected complex64 and bool")
        for k, name in enumerate(self.names):
            if not name.strip():
                raise RecognitionError(f"template {k} has an empty name; name its person")
            if not mask[k].any():
                raise RecognitionError(f"template {k} ({name}) is masked everywhere; leave it out")
            if not (all_finite(coefficients[k]) and ((self.weight[k] > 0) == mask[k]).all()):
                raise RecognitionError(
                    f"template {k} ({name}) is not finite, or weighs what is masked; make it again"
                )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def arrays(self) -> Values:
        """`coefficients`, `mask` and `weight`, by name."""
        return attributes(self, "coefficients", "mask", "weight")

    def select(self, indices: Sequence[int]) -> Templates:
        """Return the templates of the given indices, in their order."""
        chosen = np.asarray(indices, int).reshape(-1)
        names = tuple(self.names[k] for k in chosen)
        return replace(self, names=names, **{name: array[chosen] for name, array in self.arrays.items()})


def albedo_templates(
    images: Sequence[ArrayLike] | RealArray,
    names: Sequence[str],
    *,
    masks: Sequence[ArrayLike | None] | NDArray | None = None,
    options: TemplateOptions = TemplateOptions(),
) -> Templates:
    """Return the templates of albedos, in about 2 ms an image of 128 pixels.

    Raises `ValueError` when numbers do not fit together or an image is not (H, W) or (H, W, 3);
    `RecognitionError` when there is no image, an image cannot be used, or their templates differ in size;
    names it.

    Parameters
    ----------
    images : N of (H, W) or (H, W, 3)
        Linear albedos in one chart, so that a texel is the same place in all of them. Of colours the
        luminance is compared; give another channel as (H, W).
    names : N of str
        Of the persons.
    masks : N of (H, W) bool or float, or None
        Where the albedo is known, or how certain it is there, 0 (unknown) to 1 (see `certainty`); everywhere
        when omitted.
    options : TemplateOptions

    Examples
    --------
    >>> images = np.random.default_rng(0).random((2, 128, 128))
    >>> albedo_templates(images, ["ann", "bob"]).coefficients.shape
    (2, 10, 32, 32)
    """
    return _templates("albedo", images, names, masks, options)


def shape_templates(
    normals: Sequence[ArrayLike] | RealArray,
    names: Sequence[str],
    *,
    masks: Sequence[ArrayLike | None] | NDArray | None = None,
    options: TemplateOptions = TemplateOptions(),
) -> Templates:
    """Return the templates of surfaces by their normals; `unit_mean` does not apply.

    Parameters
    ----------
    normals : N of (H, W, 3)
        Unit normals in one chart and in one frame, as `GeometryImage.normal` in the model's.
    names, masks, options
        As in `albedo_templates`, whose errors are raised.
    """
    return _templates("shape", normals, names, masks, options)


def certainty(albedo: ArrayLike, expected_error: ArrayLike, mask: BoolArray) -> FloatArray:
    """Return (H, W) the part of an albedo's contrast that is its own, v / (v + e^2); 0 outside the mask.

    A texture is as certain, for its doubtful texels lie in shadow.

    Parameters
    ----------
    albedo : (H, W) or (H, W, 3)
        Linear; v is the variance of its luminance over the squared mean.
    expected_error : (H, W)
        The relative error e, as `AlbedoEstimate.expected_error`.
    mask : (H, W) bool
    """
    if not mask.any():
        return np.zeros(mask.shape)
    values = np.asarray(albedo, float)
    of_mask = (values @ LUMINANCE if values.ndim == 3 else values)[mask]
    contrast = of_mask.var() / max(of_mask.mean() ** 2, LEAST_WEIGHT)
    known = contrast / np.maximum(contrast + np.asarray(expected_error, float) ** 2, LEAST_WEIGHT)
    return np.where(mask, np.maximum(known, LEAST_WEIGHT), 0.0)


def _templates(
    kind: Kind,
    images: Sequence[ArrayLike] | RealArray,
    names: Sequence[str],
    masks: Sequence[ArrayLike | None] | NDArray | None,
    options: TemplateOptions,
) -> Templates:
    if len(images) != len(names) or (masks is not None and len(masks) != len(images)):
        counts = f"{len(images)} images, {len(names)} names, {len(images if masks is None else masks)} masks"
        raise ValueError(f"{counts}; expected as many of each")
    if len(images) == 0:
        raise RecognitionError("no image was given; templates need one or more")
    coefficients: list[NDArray[np.complex64]] = []
    weights: list[Float32Array] = []
    for k, image in enumerate(images):
        what = f"image {k} ({names[k]})"
        bands, weight = kind_coefficients(kind, image, None if masks is None else masks[k], options, what)
        if weights and weight.shape != weights[0].shape:
            raise RecognitionError(
                f"{what} has {np.shape(image)[:2]} pixels, image 0 {np.shape(images[0])[:2]}; "
                "give images of one size, or options with a size that both have"
            )
        coefficients.append(bands)
        weights.append(weight)
    weight = np.stack(weights)
    return Templates(np.stack(coefficients), weight > 0, tuple(names), options, kind=kind, weight=weight)


def kind_coefficients(
    kind: Kind, image: ArrayLike, mask: ArrayLike | None, options: TemplateOptions, what: str
) -> tuple[NDArray[np.complex64], Float32Array]:
    """Return coefficients (O, h, w) and weights (h, w) of an image, or of normals (H, W, 3)."""
    if kind != "shape":
        parts = [image_coefficients(image, mask, options, what)]
    else:
        values = np.asarray(image, float)
        if values.ndim != 3 or values.shape[2] != 3:
            raise ValueError(f"{what} has normals of shape {values.shape}, expected (H, W, 3)")
        as_they_are = replace(options, unit_mean=False)
        parts = [image_coefficients(values[..., k], mask, as_they_are, what) for k in range(3)]
    return np.concatenate([bands for bands, _ in parts]).astype(np.complex64), parts[0][1]


def image_coefficients(
    image: ArrayLike, mask: ArrayLike | None, options: TemplateOptions, what: str
) -> tuple[NDArray[np.complex128], Float32Array]:
    """Return coefficients (O, h, w), 0 outside their mask, and weights (h, w) of one image named `what`."""
    pixels, certain = _luminance(image, mask, what)
    valid = certain > 0
    if options.size is not None:
        pixels, valid = averaged_down(pixels, valid, options.size, what)
        certain = area_mean(certain, (valid.shape[0], valid.shape[1]))
    if options.unit_mean:
        with np.errstate(over="ignore"):  # refused below
            mean = float(pixels[valid].mean())
        if not 0 < mean < np.inf:
            raise NothingToCompareError(
                f"{what} has the mean {mean:g} in its mask, expected > 0 and finite; "
                "leave a black image out, or compare as it is (unit_mean=False)"
            )
        pixels = np.cbrt(pixels / mean)
    supported = supported_mask(without_holes(valid, HOLE_RADIUS))
    if not supported.any():
        raise NothingToCompareError(
            f"{what}: no coefficient lies {STEP // 2} pixels inside its mask; widen the mask"
        )
    # Followed by its mirror image on both axes: the pyramid's filters wrap around, and meet the image's own
    # edge instead of the opposite one.
    after = [(0, n + -2 * n % 2**SCALES) for n in pixels.shape]
    padded = np.pad(filled_from_nearest(pixels, valid), after, mode="symmetric")
    if min(padded.shape) < 2 ** (SCALES + 2):
        raise RecognitionError(
            f"{what} has {' x '.join(map(str, pixels.shape))} pixels, too few for {SCALES} scales; "
            "give a larger image"
        )
    bands = coarsest_bands(padded)[:, : supported.shape[0], : supported.shape[1]]
    # Of all pixels up to `STEP` / 2 beside a coefficient.
    weight = uniform_filter(certain.astype(float), STEP + 1, mode="nearest")[::STEP, ::STEP]
    weight = np.where(supported, np.clip(weight, LEAST_WEIGHT, 1.0), 0.0).astype(np.float32)
    return np.where(supported, bands, 0.0), weight


def _luminance(image: ArrayLike, mask: ArrayLike | None, what: str) -> tuple[FloatArray, NDArray]:
    """Return the luminance (H, W) of an image, 0 where it does not count, and how certain it is (H, W)."""
    pixels = np.asarray(image, float)
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3) or pixels.size == 0:
        raise ValueError(f"{what} has shape {pixels.shape}, expected (H, W) or (H, W, 3)")
    certain = np.ones(pixels.shape[:2]) if mask is None else np.asarray(mask)
    valid = certain > 0
    if valid.shape != pixels.shape[:2]:
        size, other = (" x ".join(map(str, array.shape[:2])) for array in (pixels, valid))
        raise RecognitionError(f"{what} has {size} pixels, its mask {other}; give a mask of the image's size")
    if certain.dtype.kind not in "bf" or not ((certain >= 0) & (certain <= 1)).all():
        raise ValueError(f"{what}: its mask is of {certain.dtype}, expected bool, or float within [0, 1]")
    if not valid.any():
        raise NothingToCompareError(
            f"{what} is masked everywhere; leave it out, or give a mask with valid pixels"
        )
    finite = np.isfinite(pixels) if pixels.ndim == 2 else finite_rows(pixels)
    if bad := int((valid & ~finite).sum()):
        raise RecognitionError(
            f"{what}: {bad} of {valid.sum()} pixels in its mask are not finite; take them out of the mask"
        )
    if pixels.ndim == 3:
        pixels = np.where(valid[..., None], pixels, 0.0) @ LUMINANCE
    return np.where(valid, pixels, 0.0), certain


def averaged_down(image: FloatArray, mask: BoolArray, size: int, what: str) -> tuple[FloatArray, BoolArray]:
    """Return image and mask, the longer side at most `size`; a pixel is valid where half of its area is."""
    longest = max(image.shape)
    if longest <= size:
        return image, mask
    height, width = (max(1, round(side * size / longest)) for side in image.shape)
    total, share = (area_mean(values, (height, width)) for values in (image, mask))
    valid = share >= 0.5
    if not valid.any():
        raise NothingToCompareError(f"{what} has no valid pixel left at {size} pixels a side; widen its mask")
    return np.where(valid, total / np.maximum(share, 0.5), 0.0), valid


def without_holes(mask: BoolArray, radius: float) -> BoolArray:
    """Return the mask (H, W) closed by a disc whose radius is given in sides of the image."""
    reach = round(radius * max(mask.shape))
    # Beyond the border nothing is known; without reach the closing would still wear off the edge.
    closed = isotropic_closing(np.pad(mask, reach + 1), reach) if reach else np.pad(mask, 1)
    return closed[reach + 1 : -reach - 1, reach + 1 : -reach - 1]


def supported_mask(mask: BoolArray) -> BoolArray:
    """Return (ceil(H / 4), ceil(W / 4)) where all pixels up to `STEP` / 2 beside a coefficient count."""
    return minimum_filter(mask, size=STEP + 1, mode="nearest")[::STEP, ::STEP]


def coarsest_bands(image: FloatArray) -> NDArray[np.complex128]:
    """Return the bands (O, H / 4, W / 4) of the coarsest scale of an image's complex steerable pyramid.

    A band is the inverse transform of X_k H_k over the low frequencies k that its size can hold, with the
    image's transform X and a filter H that is read off the pyramid of a point once for each size. After
    Simoncelli, Freeman, ICIP 1995, and, complex, Portilla, Simoncelli, IJCV 40, 2000.
    """
    filters = _coarsest_filters(image.shape)
    rows, columns = (np.fft.fftfreq(n, 1 / n).astype(int) for n in filters.shape[1:])
    return np.asarray(fft.ifft2(fft.fft2(image)[np.ix_(rows, columns)] * filters), np.complex128)


@lru_cache(maxsize=8)
def _coarsest_filters(shape: GridShape) -> NDArray[np.complex128]:
    with needs_extra("recognition"):
        from pyrtools.pyramids import SteerablePyramidFreq
    point = np.zeros(shape)
    point[0, 0] = 1.0
    bands = SteerablePyramidFreq(point, height=SCALES, order=ORIENTATIONS - 1, is_complex=True).pyr_coeffs
    filters = fft.fft2(np.stack([bands[(SCALES - 1, k)] for k in range(ORIENTATIONS)]))
    filters.setflags(write=False)
    return filters
