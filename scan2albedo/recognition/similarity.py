"""Complex wavelet structural similarity (CW-SSIM): of two images, and of all pairs of two template sets."""

from numbers import Integral

import numpy as np

from scan2albedo.core.arrays import ArrayLike, BoolArray, Float32Array, FloatArray, NDArray, RealArray
from scan2albedo.core.compiled import compiled
from scan2albedo.errors import RecognitionError
from scan2albedo.geometry.rays import blocks
from scan2albedo.recognition.templates import TemplateOptions, Templates, albedo_templates, common_chart

STABILIZER = 1e-3
"""K of the index, in squared coefficients summed over a window: windows with less energy count as alike.
Images have mean 1 before the pyramid."""
WINDOW = 5
"""Side of the square windows in coefficients, chosen on photographs of six people under twelve lamps, as size
and response of the templates were (`python tools/bench templates/lamps`), and on synthetic people."""
LANES = 64
"""Templates of a block of the compiled loop; they lie next to each other, so that every step is a vector
operation."""


def cw_ssim(
    a: ArrayLike,
    b: ArrayLike,
    mask: ArrayLike | None = None,
    *,
    mask_b: ArrayLike | None = None,
    options: TemplateOptions = TemplateOptions(),
    window: int = WINDOW,
) -> float:
    """Return the complex wavelet structural similarity of two images, 0 to 1, as identification computes it.

    Over windows of coefficients x, y at the same places of one orientation,

        S = (2 |sum_i x_i conj(y_i)| + K) / (sum_i |x_i|^2 + sum_i |y_i|^2 + K),

    averaged over the orientations and the windows inside the mask, each weighed by how certain both images
    are within it. A small shift turns the phases of all coefficients of a window alike and leaves S; a change
    of structure does not (Wang, Simoncelli, ICASSP 2005; Sampat, Wang, Gupta, Bovik, Markey, IEEE TIP 18(11),
    2009). Raises `ValueError` when an image is not (H, W) or (H, W, 3), or the window is not a whole number
    of 1 or more; `RecognitionError` when the sizes differ, an image cannot be used, or no window lies inside
    the mask.

    Parameters
    ----------
    a, b : (H, W) or (H, W, 3)
        Linear images of the same size.
    mask, mask_b : (H, W), optional
        Pixels that count in the first and in the second image, as in `albedo_templates`; `mask` counts in
        both when `mask_b` is omitted.
    options : TemplateOptions
    window : int
        Side of the windows in coefficients.

    Notes
    -----
    Only the coarsest scale counts, as in the templates. A shift by 2 pixels costs 0.03 of images of 128
    pixels whose amplitude falls with frequency; unrelated ones have 0.6, with windows of 7 x 7 it is 0.4.

    Examples
    --------
    >>> rows, columns = np.mgrid[:128, :128] / 128
    >>> image = 2 + np.sin(30 * rows) * np.cos(40 * columns)
    >>> round(cw_ssim(image, image), 6)
    1.0
    >>> cw_ssim(image, np.roll(image, 1, axis=1)) > 0.95 > 0.6 > cw_ssim(image, image.T)
    True
    """
    names, masks = ("the first", "the second"), (mask, mask if mask_b is None else mask_b)
    templates = albedo_templates([np.asarray(a), np.asarray(b)], names, masks=masks, options=options)
    similarity = similarity_matrix(templates.select([0]), templates.select([1]), window=window)
    return min(float(similarity[0, 0]), 1.0)  # rounding goes beyond


def has_window(templates: Templates, window: int) -> BoolArray:
    """Return (N,) whether a window lies inside each template's mask."""
    _check_window(templates.mask.shape[1:], window)
    return np.asarray(_window_weights(templates.weight, window).any(axis=(1, 2)))


def _window_weights(weight: RealArray, window: int) -> Float32Array:
    """Return the mean weight (..., h', w') of windows that lie inside the mask; 0 of others."""
    inside = _window_sums(weight > 0, window) == window**2
    mean = _window_sums(weight.astype(float), window) / window**2
    return np.where(inside, np.maximum(mean, np.finfo(np.float32).eps), 0.0).astype(np.float32)


def _window_sums(values: NDArray, window: int) -> NDArray:
    """Return sums (..., h - window + 1, w - window + 1) over all windows of values (..., h, w)."""
    sums = values.cumsum(axis=-2).cumsum(axis=-1)
    sums = np.pad(sums, [(0, 0)] * (values.ndim - 2) + [(1, 0), (1, 0)])
    low, high = slice(None, -window), slice(window, None)
    return np.asarray(
        sums[..., high, high] - sums[..., low, high] - sums[..., high, low] + sums[..., low, low]
    )


def _check_window(shape: tuple[int, ...], window: int) -> None:
    if not (isinstance(window, Integral) and window >= 1):
        raise ValueError(f"window is {window}, expected a whole number >= 1")
    if window > min(shape):
        raise RecognitionError(
            f"the window of {window} coefficients does not fit into templates of {shape}; "
            "choose a smaller window or larger images"
        )


def similarity_matrix(templates_a: Templates, templates_b: Templates, *, window: int = WINDOW) -> FloatArray:
    """Return `cw_ssim` (A, B) of all pairs, over windows inside both masks, weighed by both.

    Raises `RecognitionError` when the sets were made with other options, sizes or charts, are empty, or the
    masks of a pair have no window in common; names it.

    Parameters
    ----------
    templates_a, templates_b : Templates
        A and B templates.
    window : int
        As in `cw_ssim`.

    Notes
    -----
    The numerator of a window is an inner product, but its magnitude and the energies of the pair do not
    factor, so every window of every pair is visited: O(A B O h w), whatever the window's side. Sums are
    float32 on one thread.

    Examples
    --------
    >>> from scan2albedo.recognition import albedo_templates
    >>> templates = albedo_templates(np.random.default_rng(0).random((2, 128, 128)), ["ann", "bob"])
    >>> bool(np.allclose(np.diag(similarity_matrix(templates, templates)), 1, atol=1e-4))
    True
    """
    similarities = comparable_similarities(templates_a, templates_b, window)
    if (missing := np.isnan(similarities)).any():
        i, j = np.argwhere(missing)[0]
        pair = f"template {i} ({templates_a.names[i]}) and template {j} ({templates_b.names[j]})"
        raise RecognitionError(
            f"{pair}: no window of {window} x {window} coefficients lies inside the mask; "
            "widen the masks or choose a smaller window"
        )
    return similarities


def comparable_similarities(a: Templates, b: Templates, window: int) -> FloatArray:
    """Return `similarity_matrix` (A, B), NaN for pairs whose masks have no window in common."""
    for which, templates in (("first", a), ("second", b)):
        if len(templates) == 0:
            raise RecognitionError(f"the {which} set of templates is empty; give one template or more")
    if a.kind != b.kind:
        raise RecognitionError(
            f"the first set is of the {a.kind}, the second of the {b.kind}; compare like with like"
        )
    if a.options != b.options:
        raise RecognitionError(
            f"the sets of templates differ in their options, {a.options} and {b.options}; make them alike"
        )
    if a.mask.shape[1:] != b.mask.shape[1:]:
        raise RecognitionError(
            f"the templates have {a.mask.shape[1:]} and {b.mask.shape[1:]} coefficients; make them from "
            "images of one size"
        )
    common_chart(a.chart, b.chart, "the first set of templates", "the second")
    _check_window(a.mask.shape[1:], window)
    rows, columns = _window_weights(a.weight, window), _window_weights(b.weight, window)
    # Sums of weighed similarities over orientations and windows, and of weights, of all pairs.
    totals = np.zeros((len(a), len(b)))
    windows = np.tensordot(rows, columns, ((1, 2), (1, 2)))
    energy, lane_energy = _window_energies(a, window), _window_energies(b, window)
    for block in blocks(len(b), LANES):
        lane_weight = _lanes(columns[block])
        for o in range(a.coefficients.shape[1]):
            own = np.ascontiguousarray(a.coefficients[:, o]), np.ascontiguousarray(energy[:, o]), rows
            values = b.coefficients[block, o]
            lanes = np.stack([_lanes(values.real), _lanes(values.imag)])
            total = np.zeros((len(a), LANES), np.float32)
            settings = window, np.float32(STABILIZER)
            _add_window_similarities(
                *own, lanes, _lanes(lane_energy[block, o]), lane_weight, *settings, total
            )
            totals[:, block] += total[:, : len(values)]
    bands = a.coefficients.shape[1]
    return np.divide(totals, windows * bands, out=np.full(totals.shape, np.nan), where=windows > 0)


def _window_energies(templates: Templates, window: int) -> Float32Array:
    """Return the sum (N, O, h', w') of squared magnitudes over each window."""
    values = templates.coefficients
    energy = _window_sums(values.real.astype(float) ** 2 + values.imag.astype(float) ** 2, window)
    return np.maximum(energy, 0).astype(np.float32)


def _lanes(plane: Float32Array) -> Float32Array:
    """Return (h, w, LANES) of (N <= LANES, h, w), 0 in the lanes left over."""
    result = np.zeros((*plane.shape[1:], LANES), np.float32)
    result[..., : len(plane)] = np.moveaxis(plane, 0, -1)
    return result


@compiled(error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"})
def _add_window_similarities(  # type: ignore[no-untyped-def]
    own, energy, weight, lanes, lane_energy, lane_weight, window, stabilizer, total
):
    """Add to total (A, LANES) the similarity of one orientation, summed over windows by both weights.

    `own` (A, h, w) complex64 are the coefficients of A templates, and (2, h, w, LANES) real and imaginary
    parts of those of the lanes. `energy` is a window's sum of squared magnitudes, float32, and `weight` 0
    outside the mask: (A, h - window + 1, w - window + 1), lanes last. Sums run down columns of `window`
    coefficients, then along rows of these, both by adding what comes in and subtracting what goes out.
    """
    two = np.float32(2)
    height, width = own.shape[1:]
    column = np.empty((2, width, LANES), np.float32)
    for n in range(len(own)):
        column[:] = 0
        for y in range(height):
            gone = max(y - window, 0)
            for x in range(width):
                new = own[n, y, x]
                old = own[n, gone, x] * np.float32(y >= window)
                for k in range(LANES):
                    column[0, x, k] += new.real * lanes[0, y, x, k] + new.imag * lanes[1, y, x, k]
                    column[0, x, k] -= old.real * lanes[0, gone, x, k] + old.imag * lanes[1, gone, x, k]
                    column[1, x, k] += new.imag * lanes[0, y, x, k] - new.real * lanes[1, y, x, k]
                    column[1, x, k] -= old.imag * lanes[0, gone, x, k] - old.real * lanes[1, gone, x, k]
            row = y + 1 - window
            if row < 0:
                continue
            shared = np.zeros((2, LANES), np.float32)
            for x in range(width):
                for k in range(LANES):
                    shared[0, k] += column[0, x, k]
                    shared[1, k] += column[1, x, k]
                at = x + 1 - window
                if at < 0:
                    continue
                if weight[n, row, at] > 0:
                    for k in range(LANES):
                        numerator = two * np.sqrt(shared[0, k] ** 2 + shared[1, k] ** 2) + stabilizer
                        most = energy[n, row, at] + lane_energy[row, at, k] + stabilizer
                        total[n, k] += weight[n, row, at] * lane_weight[row, at, k] * numerator / most
                for k in range(LANES):
                    shared[0, k] -= column[0, at, k]
                    shared[1, k] -= column[1, at, k]
