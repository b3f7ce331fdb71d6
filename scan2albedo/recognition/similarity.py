"""Complex wavelet structural similarity (CW-SSIM): of two images, and of all pairs of two template sets."""

from __future__ import annotations

from numbers import Integral
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.templates import TemplateOptions, Templates, common_chart, image_coefficients

STABILIZER = 1e-3
"""K of the index, in squared coefficients summed over a window: windows with less energy count as alike.
Images have mean 1 before the pyramid."""
WINDOW = 3
"""Side of the square windows in coefficients. Charts of fitted faces are misaligned unevenly, and within a
small window the phases still turn alike: 3 tells people who are alike apart better than the usual 7
(`tools/experiment_recognition.py --other-templates`)."""
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

    averaged over the windows inside the mask and over the orientations. A small shift turns the phases of all
    coefficients of a window alike and leaves S; a change of structure does not (Wang, Simoncelli, ICASSP
    2005; Sampat, Wang, Gupta, Bovik, Markey, IEEE TIP 18(11), 2009). Raises `ValueError` when an image is not
    (H, W) or (H, W, 3), or the window is not a whole number of 1 or more; `RecognitionError` when the sizes
    differ, an image cannot be used, or no window lies inside the mask.

    Parameters
    ----------
    a, b : (H, W) or (H, W, 3)
        Linear images of the same size.
    mask, mask_b : (H, W) bool, optional
        Pixels that count in the first and in the second image, where `mask` counts too when `mask_b` is
        omitted.
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
    if np.shape(a)[:2] != np.shape(b)[:2]:
        raise RecognitionError(
            f"the images have {np.shape(a)[:2]} and {np.shape(b)[:2]} pixels; give images of one size"
        )
    first, supported = image_coefficients(a, mask, options, "the first image")
    of_second = mask if mask_b is None else mask_b
    second, also_supported = image_coefficients(b, of_second, options, "the second image")
    return pair_similarity(first, second, supported & also_supported, window)


def pair_similarity(
    a: NDArray[np.complexfloating], b: NDArray[np.complexfloating], mask: BoolArray, window: int = WINDOW
) -> float:
    """Return `cw_ssim` of coefficients (O, h, w) over windows inside a mask (h, w)."""
    _check_window(mask.shape, window)
    inside = _window_sums(mask, window) == window**2
    if not inside.any():
        raise RecognitionError(_no_window_message("the pair", window))
    a, b = a.astype(np.complex128), b.astype(np.complex128)
    shared = np.abs(_window_sums(a * b.conj(), window))
    index = (2 * shared + STABILIZER) / (_window_sums(np.abs(a) ** 2 + np.abs(b) ** 2, window) + STABILIZER)
    return min(float(index[:, inside].mean()), 1.0)  # rounding goes beyond


def has_window(templates: Templates, window: int) -> BoolArray:
    """Return (N,) whether a window lies inside each template's mask."""
    _check_window(templates.mask.shape[1:], window)
    return np.asarray((_window_sums(templates.mask, window) == window**2).any(axis=(1, 2)))


def _window_sums(values: NDArray[Any], window: int) -> NDArray[Any]:
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


def _no_window_message(what: str, window: int) -> str:
    return (
        f"{what}: no window of {window} x {window} coefficients lies inside the mask; "
        "widen the masks or choose a smaller window"
    )


def similarity_matrix(templates_a: Templates, templates_b: Templates, *, window: int = WINDOW) -> FloatArray:
    """Return `cw_ssim` (A, B) of all pairs, over windows inside both masks.

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
    float32 on one thread; they differ from `cw_ssim` by less than 1e-5.

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
        raise RecognitionError(_no_window_message(pair, window))
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
    # Sums of similarities over orientations and windows, and the numbers of windows, of all pairs. Templates
    # of the first set are prepared in parts, which bounds the memory: 0.5 MB a template of 256 pixels.
    totals, windows = np.empty((len(a), len(b))), np.empty((len(a), len(b)))
    for top in range(0, len(a), 16 * LANES):
        part = a.select(range(top, min(top + 16 * LANES, len(a))))
        rows, row_inside = _planes(part, window)
        for left in range(0, len(b), LANES):
            block = b.select(range(left, min(left + LANES, len(b))))
            columns, inside = _planes(block, window)
            total, lane_inside = np.zeros((len(part), LANES)), _lanes(inside.astype(np.float32), LANES)
            for o in range(len(rows[0])):
                own, lanes = [plane[o] for plane in rows], [_lanes(plane[o], LANES) for plane in columns]
                _add_window_similarities(
                    *own, row_inside, *lanes, lane_inside, window, np.float32(STABILIZER), total
                )
            here = slice(top, top + len(part)), slice(left, left + len(block))
            totals[here] = total[:, : len(block)]
            # float32 counts exactly up to 2^24 windows
            flat, flat_block = (x.reshape(len(x), -1).astype(np.float32) for x in (row_inside, inside))
            windows[here] = flat @ flat_block.T
    bands = a.coefficients.shape[1]
    return np.divide(totals, windows * bands, out=np.full(totals.shape, np.nan), where=windows > 0)


def _planes(templates: Templates, window: int) -> tuple[list[NDArray[np.float32]], BoolArray]:
    """Return what the kernel reads of N templates, orientations outermost, and the windows inside the mask.

    These are real and imaginary parts (O, N, h, w) and the energy of each window (O, N, h', w').
    """
    values = templates.coefficients.transpose(1, 0, 2, 3)
    energy = _window_sums(values.real.astype(np.float64) ** 2 + values.imag.astype(np.float64) ** 2, window)
    planes = [np.ascontiguousarray(part) for part in (values.real, values.imag)]
    inside = np.asarray(_window_sums(templates.mask, window) == window**2)
    return [*planes, np.maximum(energy, 0).astype(np.float32)], inside


def _lanes(plane: NDArray[np.float32], lanes: int) -> NDArray[np.float32]:
    """Return (h, w, lanes) of (N <= lanes, h, w), 0 in the lanes left over."""
    result = np.zeros((*plane.shape[1:], lanes), np.float32)
    result[..., : len(plane)] = np.moveaxis(plane, 0, -1)
    return result


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"})
def _add_window_similarities(  # type: ignore[no-untyped-def]
    real, imag, energy, valid, lane_real, lane_imag, lane_energy, lane_valid, window, stabilizer, total
):
    """Add to total (A, LANES) the similarity of one orientation, summed over windows valid in both.

    `real`, `imag` (A, h, w) float32 are the coefficients of A templates, and (h, w, LANES) those of the
    lanes. `energy` is a window's sum of squared magnitudes, float32, and `valid` whether it lies inside the
    mask: (A, h - window + 1, w - window + 1), lanes last. Sums run down columns of `window` coefficients,
    then along rows of these, both by adding what comes in and subtracting what goes out.
    """
    count, height, width = real.shape
    column_real = np.empty((width, LANES), np.float32)
    column_imag = np.empty((width, LANES), np.float32)
    sum_real, sum_imag = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    similarity = np.empty(LANES, np.float32)
    two = np.float32(2.0)
    for n in range(count):
        column_real[:] = 0.0
        column_imag[:] = 0.0
        similarity[:] = 0.0
        for y in range(height):
            gone = y - window
            for x in range(width):
                a, b = real[n, y, x], imag[n, y, x]
                if gone < 0:
                    for k in range(LANES):
                        column_real[x, k] += a * lane_real[y, x, k] + b * lane_imag[y, x, k]
                        column_imag[x, k] += b * lane_real[y, x, k] - a * lane_imag[y, x, k]
                    continue
                c, d = real[n, gone, x], imag[n, gone, x]
                for k in range(LANES):
                    column_real[x, k] += (
                        a * lane_real[y, x, k]
                        + b * lane_imag[y, x, k]
                        - c * lane_real[gone, x, k]
                        - d * lane_imag[gone, x, k]
                    )
                    column_imag[x, k] += (
                        b * lane_real[y, x, k]
                        - a * lane_imag[y, x, k]
                        - d * lane_real[gone, x, k]
                        + c * lane_imag[gone, x, k]
                    )
            if gone < -1:
                continue
            row = gone + 1
            sum_real[:] = 0.0
            sum_imag[:] = 0.0
            for x in range(window - 1):
                for k in range(LANES):
                    sum_real[k] += column_real[x, k]
                    sum_imag[k] += column_imag[x, k]
            for x in range(width - window + 1):
                for k in range(LANES):
                    sum_real[k] += column_real[x + window - 1, k]
                    sum_imag[k] += column_imag[x + window - 1, k]
                if valid[n, row, x]:
                    own = energy[n, row, x] + stabilizer
                    for k in range(LANES):
                        shared = np.sqrt(sum_real[k] * sum_real[k] + sum_imag[k] * sum_imag[k])
                        similarity[k] += (
                            lane_valid[row, x, k]
                            * (two * shared + stabilizer)
                            / (own + lane_energy[row, x, k])
                        )
                for k in range(LANES):
                    sum_real[k] -= column_real[x, k]
                    sum_imag[k] -= column_imag[x, k]
        for k in range(LANES):
            total[n, k] += similarity[k]
