"""Average measurements of an adult face."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Measurements:
    """Straight distances between soft-tissue landmarks, mm: means of adult women and men.

    Landmarks: tr trichion (hairline), n nasion, prn pronasale (tip), sn subnasale, ls/li upper and lower
    vermilion border at the midline, sto stomion (mouth line), sl sublabiale, gn gnathion (lowest of the
    chin), en/ex inner and outer eye corner, al alare (nose wing), ch cheilion (mouth corner), zy zygion,
    ft frontotemporale, go gonion.

    Parameters
    ----------
    hairline_height_mm : float
        tr-n.
    face_height_mm : float
        n-gn.
    nose_height_mm : float
        n-sn.
    nose_width_mm : float
        al-al.
    nose_protrusion_mm : float
        sn-prn.
    upper_lip_height_mm : float
        sn-sto.
    upper_face_height_mm : float
        n-sto.
    lower_face_height_mm : float
        sn-gn.
    mouth_width_mm : float
        ch-ch.
    inner_eye_width_mm, outer_eye_width_mm : float
        en-en, ex-ex.
    eye_opening_mm : float
        Between the lid margins above and below the pupil.
    face_width_mm : float
        zy-zy.
    forehead_width_mm : float
        ft-ft.
    jaw_width_mm : float
        go-go.

    References
    ----------
    .. [1] L. G. Farkas (ed.), "Anthropometry of the Head and Face", 2nd ed., Raven Press, 1994.

    >>> Measurements().face_width_mm
    134.5
    """

    hairline_height_mm: float = 65.0
    face_height_mm: float = 118.0
    nose_height_mm: float = 53.0
    nose_width_mm: float = 33.0
    nose_protrusion_mm: float = 19.5
    upper_lip_height_mm: float = 21.0
    upper_face_height_mm: float = 73.0
    lower_face_height_mm: float = 68.5
    mouth_width_mm: float = 52.0
    inner_eye_width_mm: float = 32.5
    outer_eye_width_mm: float = 89.5
    eye_opening_mm: float = 11.0
    face_width_mm: float = 134.5
    forehead_width_mm: float = 113.5
    jaw_width_mm: float = 100.5
