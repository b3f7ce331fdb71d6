"""Templates: the coarsest scale of the complex steerable pyramid of an albedo, or of a surface's normals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import RecognitionError
from scan2albedo.geometry.rasterization import filled_from_nearest
from scan2albedo.recognition.options import TemplateOptions
from scan2albedo.recognition.preparation import (
    NothingToCompareError,
    averaged_down,
    carried_mask,
    checked_image,
    mirrored,
    scaled_to_unit_mean,
    without_holes,
)
from scan2albedo.recognition.pyramid import coarsest_bands

Kind = Literal["albedo", "shape"]
"""What is compared: the albedo, or the normals of the fitted surface."""
COMPONENTS: dict[Kind, int] = {"albedo": 1, "shape": 3}
"""Images that a template holds: one channel of the albedo; x, y and z of the normals."""


@dataclass(frozen=True)
class Chart:
    """The chart of a set of images."""

    model: str | None
    """Name of the face model; None where unknown."""
    shape: tuple[int, int]
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
    """Templates of N images, and whose they are.

    Raises `ValueError` when shapes or numbers do not fit together, `RecognitionError` when a name is empty, a
    template not finite or masked everywhere; names it.
    """

    coefficients: NDArray[np.complex64]
    """(N, O, h, w): of O orientations, of one component after the other; 0 outside the mask."""
    mask: NDArray[np.bool_]
    """(N, h, w)."""
    names: tuple[str, ...]
    """(N,): of the persons; several templates may bear one name."""
    options: TemplateOptions = TemplateOptions()
    """How they were made."""
    chart: Chart | None = None
    """Of the images, where it is known; templates of different charts are not compared."""
    kind: Kind = "albedo"
    """Of what they are."""

    def __post_init__(self) -> None:
        coefficients, mask = self.coefficients, self.mask
        bands = self.options.orientations * COMPONENTS[self.kind]
        if coefficients.ndim != 4 or coefficients.shape[1] != bands:
            raise ValueError(
                f"{self.kind} coefficients have shape {coefficients.shape}, expected (N, {bands}, h, w)"
            )
        if mask.shape != coefficients.shape[:1] + coefficients.shape[2:] or len(mask) != len(self.names):
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
            if not np.isfinite(coefficients[k]).all():
                raise RecognitionError(f"template {k} ({name}) is not finite; make it again")

    def __len__(self) -> int:
        return len(self.names)

    @classmethod
    def joined(cls, parts: Sequence[Templates]) -> Templates:
        """Return the templates of several sets one after the other.

        RecognitionError when there is no set, or they were made with other options or from images of another
        size.
        """
        if not parts:
            raise RecognitionError("no set of templates was given; give one or more")
        for k, part in enumerate(parts):
            if part.kind != parts[0].kind:
                raise RecognitionError(f"set {k} is of the {part.kind}, set 0 of the {parts[0].kind}")
            if part.options != parts[0].options or part.mask.shape[1:] != parts[0].mask.shape[1:]:
                raise RecognitionError(
                    f"set {k} has templates of {part.mask.shape[1:]} made with {part.options}, set 0 of "
                    f"{parts[0].mask.shape[1:]} with {parts[0].options}; make them alike"
                )
        return cls(
            np.concatenate([part.coefficients for part in parts]),
            np.concatenate([part.mask for part in parts]),
            tuple(name for part in parts for name in part.names),
            parts[0].options,
            kind=parts[0].kind,
        )

    def select(self, indices: Sequence[int]) -> Templates:
        """Return the templates of the given indices, in their order."""
        chosen = np.asarray(indices, np.int64).reshape(-1)
        names = tuple(self.names[k] for k in chosen)
        return replace(self, coefficients=self.coefficients[chosen], mask=self.mask[chosen], names=names)


def image_coefficients(
    image: ArrayLike, mask: ArrayLike | None, options: TemplateOptions, what: str
) -> tuple[NDArray[np.complex128], NDArray[np.bool_]]:
    """Return coefficients (O, h, w), 0 outside their mask, and the mask (h, w) of one image named `what`."""
    pixels, valid = checked_image(image, mask, options.channel, what)
    if options.size is not None:
        pixels, valid = averaged_down(pixels, valid, options.size, what)
    if options.unit_mean:
        pixels = scaled_to_unit_mean(pixels, valid, what)
    carried = carried_mask(without_holes(valid, options.hole_radius), options.step)
    if not carried.any():
        raise NothingToCompareError(
            f"{what}: no coefficient lies {options.step // 2} pixels inside its mask; widen the mask"
        )
    padded = mirrored(filled_from_nearest(pixels, valid), 2**options.scales)
    if min(padded.shape) < 2 ** (options.scales + 2):
        raise RecognitionError(
            f"{what} has {' x '.join(map(str, pixels.shape))} pixels, too few for {options.scales} scales; "
            "give a larger image"
        )
    bands = coarsest_bands(padded, scales=options.scales, orientations=options.orientations)
    inner = bands[:, : carried.shape[0], : carried.shape[1]]
    return np.where(carried, inner, 0.0), carried


def normal_coefficients(
    normal: ArrayLike, mask: ArrayLike | None, options: TemplateOptions, what: str
) -> tuple[NDArray[np.complex128], NDArray[np.bool_]]:
    """Return coefficients (3 O, h, w) and mask (h, w) of the unit normals (H, W, 3) of a surface."""
    values = np.asarray(normal, np.float64)
    if values.ndim != 3 or values.shape[2] != 3:
        raise ValueError(f"{what} has normals of shape {values.shape}, expected (H, W, 3)")
    as_they_are = replace(options, unit_mean=False)
    parts = [image_coefficients(values[..., k], mask, as_they_are, what) for k in range(3)]
    return np.concatenate([bands for bands, _ in parts]), parts[0][1]


def shape_templates(
    normals: Sequence[ArrayLike] | NDArray[np.floating],
    names: Sequence[str],
    *,
    masks: Sequence[ArrayLike | None] | NDArray[np.bool_] | None = None,
    options: TemplateOptions = TemplateOptions(),
) -> Templates:
    """Return the templates of surfaces by their normals; `channel` and `unit_mean` do not apply.

    Parameters
    ----------
    normals : N of (H, W, 3)
        Unit normals in one chart and in one frame, as `GeometryImage.normal` in the model's.
    names, masks, options
        As in `albedo_templates`, whose errors are raised.
    """
    return _templates("shape", normals, names, masks, options)


def albedo_templates(
    images: Sequence[ArrayLike] | NDArray[np.floating],
    names: Sequence[str],
    *,
    masks: Sequence[ArrayLike | None] | NDArray[np.bool_] | None = None,
    options: TemplateOptions = TemplateOptions(),
) -> Templates:
    """Return the templates of albedos, in about 2 ms an image of 128 pixels.

    Parameters
    ----------
    images : N of (H, W) or (H, W, 3)
        Linear albedos in one chart, so that a texel is the same place in all of them.
    names : N of str
        Of the persons.
    masks : N of (H, W) bool, or None
        Where the albedo is known; everywhere when omitted.
    options : TemplateOptions

    Raises
    ------
    ValueError
        When numbers do not fit together or an image is not (H, W) or (H, W, 3).
    RecognitionError
        When there is no image, an image cannot be used, or their templates differ in size; names it.

    Examples
    --------
    >>> images = np.random.default_rng(0).random((2, 128, 128))
    >>> albedo_templates(images, ["ann", "bob"]).coefficients.shape
    (2, 10, 32, 32)
    """
    return _templates("albedo", images, names, masks, options)


COEFFICIENTS: dict[Kind, Callable[..., tuple[NDArray[np.complex128], NDArray[np.bool_]]]] = {
    "albedo": image_coefficients,
    "shape": normal_coefficients,
}
"""What makes one template of each kind."""


def _templates(
    kind: Kind,
    images: Sequence[ArrayLike] | NDArray[np.floating],
    names: Sequence[str],
    masks: Sequence[ArrayLike | None] | NDArray[np.bool_] | None,
    options: TemplateOptions,
) -> Templates:
    if len(images) != len(names) or (masks is not None and len(masks) != len(images)):
        counts = f"{len(images)} images, {len(names)} names, {len(images if masks is None else masks)} masks"
        raise ValueError(f"{counts}; expected as many of each")
    if len(images) == 0:
        raise RecognitionError("no image was given; templates need one or more")
    coefficients: list[NDArray[np.complex64]] = []
    carried: list[NDArray[np.bool_]] = []
    for k, image in enumerate(images):
        what = f"image {k} ({names[k]})"
        bands, mask = COEFFICIENTS[kind](image, None if masks is None else masks[k], options, what)
        if carried and mask.shape != carried[0].shape:
            raise RecognitionError(
                f"{what} has {np.shape(image)[:2]} pixels, image 0 {np.shape(images[0])[:2]}; "
                "give images of one size, or options with a size that both have"
            )
        coefficients.append(bands.astype(np.complex64))
        carried.append(mask)
    return Templates(np.stack(coefficients), np.stack(carried), tuple(names), options, kind=kind)
