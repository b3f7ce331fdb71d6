"""A registration told anew for a pose that a later stage refined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2albedo.core import PlanStep
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.geometry.mesh import far_faces
from scan2albedo.geometry.oriented_points import oriented_points
from scan2albedo.geometry.rigid import Similarity, in_principal_frame, invert_rigid, rotation_angle_rad
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.register import Registration
from scan2albedo.registration.robust_icp import rms_mm
from scan2albedo.registration.template import Template


def refined_registration(
    registration: Registration,
    scan: RawScan,
    model: AnnotatedSurface,
    model_from_scan: FloatArray,
    face_scale: float,
    *,
    options: RegistrationOptions = RegistrationOptions(),
) -> Registration:
    """Return the registration with a refined pose (4, 4) and face scale, the RMS distance measured there.

    A row of its plan says how far that pose is from the one before. All else, `depth_error` too, is of the
    search.
    """
    faces = scan.faces[~far_faces(scan.vertices, scan.faces)]
    # In the frame of the search, so that the same pose has the same distance.
    vertices, prepared_from_scan = in_principal_frame(scan.vertices, faces)
    samples = oriented_points(vertices, faces, options.scan_spacing_mm)
    template = Template.of(model, options.model_spacing_mm, 0)
    prepared_from_model = prepared_from_scan @ invert_rigid(model_from_scan)
    pose = Similarity.of_rigid(prepared_from_model, face_scale, model.front)
    change = model_from_scan @ invert_rigid(registration.model_from_scan)
    turned_deg = np.rad2deg(rotation_angle_rad(change[:3, :3]))
    evidence = f"{turned_deg:.1f} degrees and {np.linalg.norm(change[:3, 3]):.1f} mm from the search's"
    step = PlanStep("register.refined_pose", True, "the pose with which the fit ended", evidence)
    return replace(
        registration,
        model_from_scan=model_from_scan,
        face_scale=face_scale,
        rmse_mm=rms_mm(samples, template, pose),
        plan=registration.plan + [step],
    )
