"""Complex wavelet structural similarity (CW-SSIM): of two images, and of all pairs of two template sets."""

from numbers import Integral

import numpy as np

from scan2albedo.core.arrays import ArrayLike, BoolArray, Float32Array, FloatArray, NDArray, RealArray
from scan2albedo.core.compiled import compiled
from scan2albedo.errors import RecognitionError
from scan2albedo.geometry.rays import blocks
from scan2albedo.recognition.templates import TemplateOptions, Templates, common_chart, image_coefficients

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
    if np.shape(a)[:2] != np.shape(b)[:2]:
        raise RecognitionError(
            f"the images have {np.shape(a)[:2]} and {np.shape(b)[:2]} pixels; give images of one size"
        )
    first = image_coefficients(a, mask, options, "the first image")
    second = image_coefficients(b, mask if mask_b is None else mask_b, options, "the second image")
    return pair_similarity(*first, *second, window)


def pair_similarity(
    a: NDArray, weight_a: NDArray, b: NDArray, weight_b: NDArray, window: int = WINDOW
) -> float:
    """Return `cw_ssim` of coefficients (O, h, w) with their weights (h, w), 0 outside the masks."""
    _check_window(weight_a.shape, window)
    weight = _window_weights(weight_a, window) * _window_weights(weight_b, window)
    if not weight.any():
        raise RecognitionError(_no_window_message("the pair", window))
    a, b = a.astype(np.complex128), b.astype(np.complex128)
    shared = np.abs(_window_sums(a * b.conj(), window))
    index = (2 * shared + STABILIZER) / (_window_sums(np.abs(a) ** 2 + np.abs(b) ** 2, window) + STABILIZER)
    return min(float((index.mean(axis=0) * weight).sum() / weight.sum()), 1.0)  # rounding goes beyond


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


def _no_window_message(what: str, window: int) -> str:
    return (
        f"{what}: no window of {window} x {window} coefficients lies inside the mask; "
        "widen the masks or choose a smaller window"
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
    # Sums of weighed similarities over orientations and windows, and of weights, of all pairs. Templates of
    # the first set are prepared in parts, which bounds the memory: 0.5 MB a template of 256 pixels.
    totals, windows = np.empty((len(a), len(b))), np.empty((len(a), len(b)))
    for above in blocks(len(a), 16 * LANES):
        part = a.select(range(len(a))[above])
        rows, row_weight = _planes(part, window)
        for beside in blocks(len(b), LANES):
            block = b.select(range(len(b))[beside])
            columns, weight = _planes(block, window)
            total, lane_weight = np.zeros((len(part), LANES)), _lanes(weight)
            for o in range(len(rows[0])):
                own, lanes = [plane[o] for plane in rows], [_lanes(plane[o]) for plane in columns]
                settings = window, np.float32(STABILIZER)
                _add_window_similarities(*own, row_weight, *lanes, lane_weight, *settings, total)
            totals[above, beside] = total[:, : len(block)]
            windows[above, beside] = row_weight.reshape(len(part), -1) @ weight.reshape(len(block), -1).T
    bands = a.coefficients.shape[1]
    return np.divide(totals, windows * bands, out=np.full(totals.shape, np.nan), where=windows > 0)


def _planes(templates: Templates, window: int) -> tuple[list[Float32Array], Float32Array]:
    """Return what the kernel reads of N templates, orientations outermost, and the weights of the windows.

    These are real and imaginary parts (O, N, h, w) and the energy of each window (O, N, h', w').
    """
    values = templates.coefficients.transpose(1, 0, 2, 3)
    energy = _window_sums(values.real.astype(float) ** 2 + values.imag.astype(float) ** 2, window)
    planes = [np.ascontiguousarray(part) for part in (values.real, values.imag)]
    return [*planes, np.maximum(energy, 0).astype(np.float32)], _window_weights(templates.weight, window)


def _lanes(plane: Float32Array) -> Float32Array:
    """Return (h, w, LANES) of (N <= LANES, h, w), 0 in the lanes left over."""
    result = np.zeros((*plane.shape[1:], LANES), np.float32)
    result[..., : len(plane)] = np.moveaxis(plane, 0, -1)
    return result


@compiled(error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"})
def _add_window_similarities(  # type: ignore[no-untyped-def]
    real, imag, energy, weight, lane_real, lane_imag, lane_energy, lane_weight, window, stabilizer, total
):
    """Add to total (A, LANES) the similarity of one orientation, summed over windows by both weights.

    `real`, `imag` (A, h, w) float32 are the coefficients of A templates, and (h, w, LANES) those of the
    lanes. `energy` is a window's sum of squared magnitudes, float32, and `weight` 0 outside the mask: (A,
    h - window + 1, w - window + 1), lanes last. Sums run down columns of `window` coefficients,
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
                count_as = weight[n, row, x]
                if count_as > 0:
                    own = energy[n, row, x] + stabilizer
                    for k in range(LANES):
                        shared = np.sqrt(sum_real[k] * sum_real[k] + sum_imag[k] * sum_imag[k])
                        similarity[k] += (
                            count_as
                            * lane_weight[row, x, k]
                            * (two * shared + stabilizer)
                            / (own + lane_energy[row, x, k])
                        )
                for k in range(LANES):
                    sum_real[k] -= column_real[x, k]
                    sum_imag[k] -= column_imag[x, k]
        for k in range(LANES):
            total[n, k] += similarity[k]
