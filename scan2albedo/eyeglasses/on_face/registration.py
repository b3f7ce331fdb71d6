"""Glasses registered on a face from key points and masks in calibrated views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from scan2albedo.core import Budget, Meter, ProgressCallback
from scan2albedo.eyeglasses.on_face.registration_inputs import checked_inputs
from scan2albedo.eyeglasses.on_face.registration_options import FaceRegistrationOptions
from scan2albedo.eyeglasses.on_face.registration_result import RegisteredEyeglasses
from scan2albedo.eyeglasses.on_face.registration_run import RegistrationRun


def register_on_face(
    glasses: Any,
    keypoints_2d: ArrayLike,
    masks: Sequence[ArrayLike | None] | ArrayLike | None,
    cameras: ArrayLike,
    budget: Budget | float | None = None,
    *,
    head: Any | None = None,
    start: ArrayLike | None = None,
    shapes: Sequence[tuple[int, int]] | None = None,
    options: FaceRegistrationOptions = FaceRegistrationOptions(),
    on_progress: ProgressCallback | None = None,
) -> RegisteredEyeglasses:
    """Place a frame where calibrated pictures show it, bent as they show it.

    Minimises over the frame's pose and the shifts of its key points

        sum rho(project(x_k) - l_ck) + sum rho(d_c(project(y_i))) + bend's prior,

    l_ck the labels, y_i the points that make the frame's outline in view c, d_c the distance from the outline
    of its mask; first the pose alone on the labels, then bent, then with the outlines, which are traced anew
    as the frame moves. Steps are Levenberg-Marquardt's, with all derivatives in closed form.

    Parameters
    ----------
    glasses : object or tuple
        With attributes vertices (V, 3), faces (F, 3), keypoints (20, 3) and maybe weights (V, 20), such as
        `CanonicalEyeglasses`; or a tuple of these. Key points in the order of `KEY_POINT_NAMES`, NaN for
        those that the frame lacks. Any unit, the cameras' own.
    keypoints_2d : (C, 20, 2) array_like of float
        Labels in pixels (column, row), centres of pixels at integers; NaN for missing ones.
    masks : sequence of C (H, W) array_like, or None
        Nonzero where a view shows the frame: what its mesh covers, so that lenses count if the mesh has them.
        None, also for a single view, where there is no segmentation. An empty one does not count.
    cameras : (C, 3, 4) array_like of float
        Projection matrices of any scale and sign.
    budget : Budget or float, optional
        Seconds, or evaluations of the objective.
    head : optional
        What may hide the frame, such as the fitted face: an object with vertices and faces, or a tuple of
        them, in the cameras' frame. Without it hidden temples are taken for wrongly placed ones.
    start : (4, 4) array_like, optional
        `world_from_glasses`, about; needed only where the labels fix no pose.
    shapes : sequence of C (H, W), optional
        Of the pictures: where a view has no mask, they tell which of the frame's points lie outside.
    options : FaceRegistrationOptions
    on_progress : callable, optional
        Called with each row of the trace.

    Returns
    -------
    RegisteredEyeglasses

    Raises
    ------
    EyeglassesError
        When the labels fix no pose and there is no start, left and right are exchanged, units differ,
        labels lie outside their pictures, weights cannot be solved, or numbers are not finite.
    ValueError
        When shapes do not fit together.

    Notes
    -----
    What the pictures do not tell is reported: `observed`, `deviation`, `unobserved`. Deviations hold for the
    frame as given: register its own mesh, or one with its own measures; a canonical frame has those of the
    mean. Where more than a third of the labels do not fit, nothing counts as observed; where exchanging left
    and right explains them, that is an error. Masks that contradict good labels are left aside.

    The paper [1]_ minimises a rendered segmentation with Adam, some thousand renderings; this takes about a
    hundred evaluations.

    References
    ----------
    .. [1] J. Li et al., "MEGANE: Morphable Eyeglass and Avatar Network", CVPR 2023, supplement, equation S3.

    Examples
    --------
    >>> import numpy as np
    >>> from scan2albedo.synthetic import wearer
    >>> person = wearer(seed=1)
    >>> g = person.glasses
    >>> found = register_on_face(
    ...     (g.rest_vertices, g.faces, g.rest_keypoints), person.labels, person.masks, person.cameras,
    ...     head=(person.head_vertices, person.head_faces))
    >>> bool(np.linalg.norm(found.vertices - person.vertices, axis=1).mean() < 0.5)
    True
    """
    meter = Meter("glasses", "px", Budget.of(budget), on_progress)
    given = checked_inputs(glasses, keypoints_2d, masks, cameras, head, start, shapes)
    with threadpool_limits(1, "blas"):
        # Matrices of 66 rows: more threads only wait for each other.
        return RegistrationRun(given, options, meter).result()
