"""Complex wavelet similarity of all pairs of two sets of templates, in blocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.chart import common_chart
from scan2albedo.recognition.options import SimilarityOptions
from scan2albedo.recognition.similarity import check_window, no_window_message, window_sums
from scan2albedo.recognition.templates import Templates

FloatArray = NDArray[np.float64]

_ROWS = 1024
"""Templates prepared at once of the first set; bounds the memory, about 0.2 MB a template."""


def similarity_matrix(
    templates_a: Templates, templates_b: Templates, *, options: SimilarityOptions = SimilarityOptions()
) -> FloatArray:
    """Return the similarities (A, B), see `cw_ssim`, of all pairs, over windows inside both masks.

    Parameters
    ----------
    templates_a, templates_b : Templates
        A and B of them.
    options : SimilarityOptions

    Raises
    ------
    RecognitionError
        When the sets were made with other options, sizes or charts, are empty, or the masks of a pair have no
        window in common; names it.

    Notes
    -----
    The numerator of a window is an inner product, but its magnitude and the energies of the pair do not
    factor, so every window of every pair is visited: O(A B O h w), whatever the window's side. Sums are
    float32 on one thread; they differ from `cw_ssim` by less than 1e-5.

    Examples
    --------
    >>> import numpy as np
    >>> from scan2albedo.recognition import albedo_templates
    >>> templates = albedo_templates(np.random.default_rng(0).random((2, 128, 128)), ["ann", "bob"])
    >>> bool(np.allclose(np.diag(similarity_matrix(templates, templates)), 1, atol=1e-4))
    True
    """
    _check_sets(templates_a, templates_b, options)
    rows = [
        _similarity_rows(
            templates_a.select(range(start, min(start + _ROWS, len(templates_a)))), templates_b, options
        )
        for start in range(0, len(templates_a), _ROWS)
    ]
    totals, windows = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    if (windows == 0).any():
        i, j = np.argwhere(windows == 0)[0]
        pair = f"template {i} ({templates_a.names[i]}) and template {j} ({templates_b.names[j]})"
        raise RecognitionError(no_window_message(pair, options))
    return np.asarray(totals / (windows * templates_a.options.orientations), np.float64)


@dataclass(frozen=True)
class _Planes:
    """Templates as the kernel reads them: orientations outermost, and what does not depend on the pair."""

    real: NDArray[np.float32]
    imaginary: NDArray[np.float32]
    energy: NDArray[np.float32]
    """(O, N, h', w') of each window."""
    inside: NDArray[np.bool_]
    """(N, h', w'): windows inside the mask."""

    @classmethod
    def of(cls, templates: Templates, window: int) -> _Planes:
        values = templates.coefficients.transpose(1, 0, 2, 3)
        energy = window_sums(
            values.real.astype(np.float64) ** 2 + values.imag.astype(np.float64) ** 2, window
        )
        return cls(
            np.ascontiguousarray(values.real),
            np.ascontiguousarray(values.imag),
            np.maximum(energy, 0).astype(np.float32),
            np.asarray(window_sums(templates.mask, window) == window**2),
        )


def _similarity_rows(a: Templates, b: Templates, options: SimilarityOptions) -> tuple[FloatArray, FloatArray]:
    """Return the sums of similarities over orientations and windows, and the numbers of windows, (A, B)."""
    from scan2albedo.recognition.similarity_kernels import LANES

    rows = _Planes.of(a, options.window)
    totals, windows = np.empty((len(a), len(b))), np.empty((len(a), len(b)))
    for start in range(0, len(b), LANES):
        block = b.select(range(start, min(start + LANES, len(b))))
        columns = _Planes.of(block, options.window)
        here = slice(start, start + len(block))
        totals[:, here] = _block_sums(rows, columns, options)[:, : len(block)]
        # float32 counts exactly up to 2^24 windows
        windows[:, here] = _flat(rows.inside) @ _flat(columns.inside).T
    return totals, windows


def _block_sums(rows: _Planes, columns: _Planes, options: SimilarityOptions) -> FloatArray:
    from scan2albedo.recognition.similarity_kernels import LANES, add_window_similarities

    inside = _lanes(columns.inside.astype(np.float32), LANES)
    total = np.zeros((len(rows.inside), LANES))
    for o in range(len(rows.real)):
        add_window_similarities(
            rows.real[o],
            rows.imaginary[o],
            rows.energy[o],
            rows.inside,
            _lanes(columns.real[o], LANES),
            _lanes(columns.imaginary[o], LANES),
            _lanes(columns.energy[o], LANES),
            inside,
            options.window,
            np.float32(options.stabilizer),
            total,
        )
    return total


def _lanes(plane: NDArray[np.float32], lanes: int) -> NDArray[np.float32]:
    """Return (h, w, lanes) of (N <= lanes, h, w), 0 in the lanes left over."""
    result = np.zeros((*plane.shape[1:], lanes), np.float32)
    result[..., : len(plane)] = np.moveaxis(plane, 0, -1)
    return result


def _flat(inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    return inside.reshape(len(inside), -1).astype(np.float32)


def _check_sets(a: Templates, b: Templates, options: SimilarityOptions) -> None:
    for which, templates in (("first", a), ("second", b)):
        if len(templates) == 0:
            raise RecognitionError(f"the {which} set of templates is empty; give one template or more")
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
    check_window(a.mask.shape[1:], options)
