"""Synthetic wearers' own frames: registered on them, photographed, and their files."""

import numpy as np
from scipy.ndimage import gaussian_filter

from helpers.measures import rms, row_lengths
from helpers.wearers import rest_frame
from scan2albedo.eyeglasses import register_on_face
from scan2albedo.runs.eyeglasses.demo import write_wearer


def register(worn, **changes):
    """Register a wearer's frame as it was before it was bent, with some arguments changed."""
    given = {
        "glasses": rest_frame(worn.sitter.seed),
        "keypoints_2d": worn.labels,
        "masks": worn.masks,
        "cameras": worn.cameras,
        "head": (worn.head_vertices, worn.head_faces),
    }
    return register_on_face(**{**given, **changes})


def front_error_mm(vertices, worn):
    """Return the root mean square distance of a frame's front from the truth."""
    front = worn.glasses.rest_vertices[:, 2] > worn.glasses.rest_keypoints[:, 2].max() - 20
    return rms(row_lengths(vertices - worn.vertices)[front])


def photographs(worn, shown=True):
    """Return pictures (H, W, 3) of a dark frame, unless it is not shown, before mottled skin."""
    rng, made = np.random.default_rng(0), []
    for mask in worn.masks:
        mottle = gaussian_filter(rng.normal(size=mask.shape), 4)[..., None]
        skin = np.array([180.0, 130, 110]) * (1 + 1.5 * mottle)
        linear = np.where((mask & shown)[..., None], [40.0, 35, 38], skin)
        made.append(gaussian_filter(linear, (0.7, 0.7, 0)) + rng.normal(0, 4, skin.shape))
    return made


def wearer_files(worn, out):
    """Return the folder, in `out`, with the files of a wearer."""
    write_wearer(worn, (worn.head_vertices, worn.head_faces), out)
    return out / "input"
