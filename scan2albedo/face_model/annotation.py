"""What the model knows about each part of the face."""

from __future__ import annotations

from dataclasses import dataclass

MOUTH_REGION = "between_lips"
"""The film between the lips, which closes the model's surface. It is no skin: no scan pulls at it."""


@dataclass(frozen=True)
class Region:
    """One annotated region of the face.

    Parameters
    ----------
    name : str
        For example "nose" or "left_cheek" (the subject's left, +x).
    index : int
        Value in `AnnotatedFaceModel.region`, 0 ... 254.
    stiffness : float
        Relative stiffness in the fit, 1 = average; rigid parts (forehead, nose) are above.
    specular_scale : float
        Relative strength of highlights expected there, 1 = average skin, 0 = none.
    inpaint : bool
        Whether saturated texels may be filled by exemplar synthesis there.
    """

    name: str
    index: int
    stiffness: float = 1.0
    specular_scale: float = 1.0
    inpaint: bool = True
