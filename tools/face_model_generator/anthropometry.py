"""Average measurements of an adult face."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Measurements:
    """Measures between soft-tissue landmarks, mm and degrees: means of adult women and men.

    Landmarks: tr trichion (hairline), n nasion, prn pronasale (tip), sn subnasale, ls/li upper and lower
    vermilion border at the midline, sto stomion (mouth line), sl sublabiale, gn gnathion (lowest of the
    chin), en/ex inner and outer eye corner, al alare (nose wing), ch cheilion (mouth corner), zy zygion,
    ft frontotemporale, go gonion, g glabella, pg pogonion (front of the chin), t tragion (notch above the
    ear's tragus), eu euryon (side of the head), op opisthocranion (back of the head), v vertex. Depths "in
    natural head position" are measured forward from a true vertical line through subnasale.

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
    ear_width_mm : float
        t-t [1]_.
    upper_face_depth_mm, middle_face_depth_mm, lower_face_depth_mm : float
        t-n, t-sn, t-gn [1]_.
    eye_corner_to_ear_mm : float
        ex-t [1]_.
    jaw_length_mm, jaw_height_mm : float
        go-gn, go-t [1]_.
    head_width_mm, head_length_mm, head_height_mm : float
        eu-eu, g-op, v-n [1]_.
    nasofrontal_angle_deg : float
        g-n-prn [1]_, [5]_; Western mean of [7]_.
    nasolabial_angle_deg : float
        Between columella and upper lip [1]_, [5]_.
    facial_angle_deg : float
        Of the line n-pg to the Frankfort horizontal [3]_.
    glabella_mm, tip_mm, upper_lip_pit_mm, upper_lip_mm, lower_lip_mm, lip_chin_fold_mm, chin_mm : float
        Depths of g, prn, the deepest point between sn and ls, the most forward points of the lips, sl
        and pg in natural head position [2]_; the lips between that and their norms to the line sn-pg [4]_,
        [5]_, the glabella between that and the norm of the facial convexity [4]_.
    orbital_rim_mm, under_pupil_mm, wing_base_mm : float
        Depths in natural head position [2]_ of the lower orbital rim, of the cheek below the pupil, and
        of the deepest point beside the nose's wing.
    pupil_distance_mm : float
        Between the pupils.
    eyeball_radius_mm, cornea_mm : float
        Radius of the globe, and how far the cornea's top stands before the globe's sphere.
    nasion_before_cornea_mm : float
        Depth of the nasion before the corneal plane [6]_.
    arch_width_mm, arch_depth_mm, lip_thickness_mm : float
        Upper dental arch at the first molars and from there to the incisors; thickness of the lips
        before the incisors [2]_.

    Notes
    -----
    Values were quoted from secondary sources, partly from memory, and rounded to means of women and men;
    only [5]_, [6]_ and [7]_ were consulted, for angles, lips and the nasion. Treat all as good to a few
    millimetres or degrees. Where sources differ, the value within their range was chosen by looking at
    the model and at its mean distances to measured faces; no depth was read from a measured face.

    References
    ----------
    .. [1] L. G. Farkas (ed.), "Anthropometry of the Head and Face", 2nd ed., Raven Press, 1994.
    .. [2] G. W. Arnett et al., "Soft tissue cephalometric analysis: diagnosis and treatment planning of
       dentofacial deformity", Am. J. Orthod. Dentofacial Orthop. 116(3), 1999.
    .. [3] R. A. Holdaway, "A soft-tissue cephalometric analysis and its use in orthodontic treatment
       planning. Part I", Am. J. Orthod. 84(1), 1983.
    .. [4] H. L. Legan, C. J. Burstone, "Soft tissue cephalometric analysis for orthognathic surgery",
       J. Oral Surg. 38(10), 1980.
    .. [5] "Surface angles, planes, and measurements", Rhinoplasty Dissection Manual,
       therhinoplastycenter.com.
    .. [6] A. Mowlavi, D. G. Meldrum, B. J. Wilhelmi, "Implications for nasal recontouring", Aesthetic
       Plast. Surg. 27, 2003.
    .. [7] C. W. Park, M. J. Lee, Y. I. Jung, "Photogrammetric facial analysis of attractive celebrities using
       the glabella", Arch. Aesthetic Plast. Surg. 24(3), 2018.

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
    ear_width_mm: float = 140.0
    upper_face_depth_mm: float = 118.0
    middle_face_depth_mm: float = 123.0
    lower_face_depth_mm: float = 138.0
    eye_corner_to_ear_mm: float = 78.0
    jaw_length_mm: float = 94.0
    jaw_height_mm: float = 67.0
    head_width_mm: float = 147.5
    head_length_mm: float = 192.0
    head_height_mm: float = 111.0
    nasofrontal_angle_deg: float = 134.0
    nasolabial_angle_deg: float = 102.0
    facial_angle_deg: float = 91.0
    glabella_mm: float = -8.8
    tip_mm: float = 16.0
    upper_lip_pit_mm: float = -0.2
    upper_lip_mm: float = 3.0
    lower_lip_mm: float = 0.8
    lip_chin_fold_mm: float = -6.2
    chin_mm: float = -3.0
    orbital_rim_mm: float = -20.5
    under_pupil_mm: float = -16.6
    wing_base_mm: float = -14.0
    pupil_distance_mm: float = 62.5
    eyeball_radius_mm: float = 12.0
    cornea_mm: float = 1.0
    nasion_before_cornea_mm: float = 10.0
    arch_width_mm: float = 54.0
    arch_depth_mm: float = 36.0
    lip_thickness_mm: float = 12.5
