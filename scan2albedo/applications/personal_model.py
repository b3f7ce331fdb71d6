"""`personal_model`: a face model in one person's shape, to fit that person's other scans from."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scan2albedo.face_model import AnnotatedFaceModel
    from scan2albedo.fitting import FittedFace


def personal_model(fitted: FittedFace) -> AnnotatedFaceModel:
    """Return the fitted face's model with the control points that the fit found.

    Chart, regions, name and triangles stay, so faces processed with it go with faces processed with the model
    itself. An expression that starts from the person's own face at rest, and not from the model's, mostly
    ends with what did not move where it was. For `transfer_expression` there is no need of it: that finds out
    which points correspond by itself, and better (the figures are with `refined_expression`).

    Parameters
    ----------
    fitted : FittedFace
        Of the person at rest.

    Examples
    --------
    >>> import scan2albedo as s2a
    >>> def smile_of(rest, smiling):  # two scans of one person
    ...     at_rest = s2a.process(rest)
    ...     return at_rest, s2a.process(smiling, model=s2a.applications.personal_model(at_rest.fitted))
    """
    return replace(fitted.model, control_vertices=fitted.control_points)
