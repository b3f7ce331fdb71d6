"""Which of a scan's colours a picture showed: not what is transparent, nor what a program filled in."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray

_LOOKS = np.array([*np.ones((1, 3)) / 3, *np.eye(3), *(1 - np.eye(3)) / 2])
"""(7, 3) barycentric places where a face is looked at: its middle, its corners, the middles of its sides."""


def seen_colors(
    colors: NDArray[np.float32], faces: IntArray, uv: FloatArray | None = None
) -> tuple[NDArray[np.float32], BoolArray | None]:
    """Return colours without alpha, and which of them some picture showed; None where that is all.

    They are those of a texture (H, W, 3 or 4) with coordinates `uv` (F, 3, 2) in [0, 1], or of vertices
    (V, 3 or 4), of which `faces` (F, 3) has the corners; nothing is seen where no face shows anything. What
    has less than half of the largest alpha was not seen, nor was the colour that programs fill in: more faces
    are wholly of it than of any other, by more than chance. The faces of one colour that smooth or coarse
    pictures have share many colours. Clipped white is seen, unless all is white. O(F + H W).
    """
    shown = np.ones(colors.shape[:-1], bool)
    if colors.shape[-1] == 4:
        shown, colors = colors[..., 3] >= 0.5 * colors[..., 3].max(), np.ascontiguousarray(colors[..., :3])
    flat = colors.reshape(-1, 3)
    height, width = colors.shape[:2] if uv is not None else (1, 1)

    def looked_at(look: FloatArray) -> IntArray:
        """Return (F,) the texel, or the vertex, of each face at a barycentric place."""
        if uv is None:
            return faces[:, int(look.argmax())]
        u, v = np.einsum("k,fkc->cf", look, uv)
        row, column = ((1 - v) * height).astype(np.int64), (u * width).astype(np.int64)
        return np.clip(row, 0, height - 1) * width + np.clip(column, 0, width - 1)

    middle = looked_at(_LOOKS[0])
    alike = shown.ravel()[middle]
    for look in _LOOKS[1:]:
        alike[alike] = (flat[looked_at(look)[alike]] == flat[middle[alike]]).all(1)
    values, counts = np.unique(flat[middle[alike]], axis=0, return_counts=True)
    if len(values) > 1 or not alike.all():
        counts[(values >= 1).all(1)] = 0
    # Poisson: log odds against no more than the second colour has, the prior odds being one face of all.
    beside, most = np.maximum(np.sort([1, 1, *counts])[-2:], 1).tolist()
    if most * math.log(most / beside) - (most - beside) > math.log(len(faces)):
        shown &= (colors != values[counts.argmax()]).any(-1)
    shown &= shown.ravel()[middle].any()
    return colors, None if shown.all() else shown
