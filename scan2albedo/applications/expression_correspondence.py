"""Which point of a face at rest is which point of the same face with an expression."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scan2albedo.applications.personal_model import limit_control_points
from scan2albedo.applications.processed_face import FaceMesh
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.face_model.annotation import MOUTH_REGION
from scan2albedo.fitting import FitOptions, fit
from scan2albedo.fitting.mouth_opening import ANGLES_DEG, JawHinge

FloatArray = NDArray[np.float64]

REFIT = FitOptions(
    bending_mm=(20.0, 2.0),
    tangential=0.0,
    finest_level=0,
    rigid_iterations=0,
    proportion_iterations=0,
    scale_range=(1.0, 1.0),
    smoothing_mm=0.0,
)
"""One person twice, in one frame, without noise: pose, size and proportions are known, and nothing along the
surface is to be believed but what keeps the sheet smooth."""


def refined_expression(
    rest: FaceMesh, moved: FloatArray, model: AnnotatedFaceModel, level: int
) -> FloatArray:
    """Return where each vertex of the face at rest is with the expression, (V, 3) mm.

    Two fits of one person slide along the skin each in its own way. So the face at rest itself becomes the
    model, its jaw turned by the angle between the two fits, and is fitted to the surface that the
    expression's fit found; the film that spans an open mouth there is left out.

    Parameters
    ----------
    rest : FaceMesh
    moved : (V, 3) float64
        The same mesh fitted to the expression, in the frame of `rest`.
    model : AnnotatedFaceModel
        That both were fitted with.
    level : int
        `refinement_level` of the mesh.

    Raises
    ------
    FitError
        When the two surfaces do not lie together.

    Notes
    -----
    1.4 s CPU. Where both surfaces are the same the answer is `rest`, to rounding. Skin without features
    (cheeks, forehead) is carried by what surrounds it: its shape does not show how it slides.

    Mean errors in mm of points of light-stage shapes given to another person, everything registered and
    fitted with the default model (``tools/bench_applications.py expression``):

    ==========================  ==============  =========  ==============  =======  ==========
    expression                  nothing given   as fitted  from A at rest  refined  true for A
    ==========================  ==============  =========  ==============  =======  ==========
    smile                       3.14            1.72       1.40            1.10     0.54
    left half of a smile        1.64            0.94       0.82            0.63     0.36
    open jaw                    4.19            2.17       1.72            1.38     0.92
    mean of nine pairs          3.25            1.70       1.60            1.14     0.55
    mean of four, synthetic     1.10            0.84       0.84            0.79     0.13
    ==========================  ==============  =========  ==============  =======  ==========

    "From A at rest" is as fitted with `personal_model`; "true for A" gives B what A's points truly did. The
    skin of the synthetic people has no features but lips, nose and eyes, and their expressions are small.
    """
    subdivision = model.subdivision(level)
    at_rest, as_fitted = (limit_control_points(v, subdivision) for v in (rest.vertices, moved))
    start = replace(model, control_vertices=_with_jaw_turned(model, at_rest, as_fitted))
    skin = ~model.in_region(MOUTH_REGION)[subdivision.parent]
    scan = RawScan(subdivision.matrix @ as_fitted, rest.faces[skin], name="the face with the expression")
    fitted = fit(scan, start, np.eye(4), options=REFIT)
    return np.asarray(rest.vertices + subdivision.matrix @ (fitted.control_points - at_rest))


def _with_jaw_turned(model: AnnotatedFaceModel, at_rest: FloatArray, as_fitted: FloatArray) -> FloatArray:
    hinge = JawHinge.of(model, at_rest)
    if hinge is None:
        return at_rest
    angle = np.clip(hinge.angle_deg(at_rest, as_fitted), 0.0, ANGLES_DEG[-1])
    return hinge.opened(at_rest, float(angle))
