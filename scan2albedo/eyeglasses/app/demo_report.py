"""What the demo of glasses found, against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scan2albedo.eyeglasses.app.registration import PlacedFrame
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import camera_centers
from scan2albedo.synthetic import Wearer

FloatArray = NDArray[np.float64]
Head = Literal["fitted", "true", "none"]


@dataclass(frozen=True)
class GlassesDemoReport:
    """What the registration found, against the truth; lengths in mm.

    Parameters
    ----------
    placed : PlacedFrame
    head : str
        What was given as head: the person's "fitted" face, "true" head, or "none".
    seen_rms_mm, seen_max_mm : float
        Errors of the vertices that the true head leaves visible in a view or more.
    seen_share : float
        Of the vertices.
    all_rms_mm, all_max_mm : float
        Errors of all vertices.
    observed_rms_mm : float
        Errors of the vertices that the registration calls observed.
    observed_share : float
        Of the vertices.
    observed_deviation_mm : float
        Root mean square of the standard deviations that it states for them, each in its worst direction.
    keypoints_rms_mm, keypoints_max_mm : float
        Errors of the key points.
    depth_error_mm, depth_deviation_mm : float
        Error of the key points along the line of sight, in the view where it is least, and what is stated.
    seconds : float
        Of the registration.
    """

    placed: PlacedFrame
    head: Head
    seen_rms_mm: float
    seen_max_mm: float
    seen_share: float
    all_rms_mm: float
    all_max_mm: float
    observed_rms_mm: float
    observed_share: float
    observed_deviation_mm: float
    keypoints_rms_mm: float
    keypoints_max_mm: float
    depth_error_mm: float
    depth_deviation_mm: float
    seconds: float

    def figures(self) -> dict[str, Any]:
        """Return the figures as plain values for JSON."""
        plain = {k: v for k, v in vars(self).items() if isinstance(v, int | float | str)}
        return {**plain, "converged": self.placed.result.converged, "views": self.placed.view_figures()}

    def table(self) -> str:
        """Return the figures as text for a terminal."""
        heads = {"fitted": "face fitted to a scan", "true": "true head", "none": "no head"}
        rows = (
            ("visible vertices", self.seen_rms_mm, self.seen_max_mm, f"{self.seen_share:.1%} of the frame"),
            ("all vertices", self.all_rms_mm, self.all_max_mm, ""),
            ("key points", self.keypoints_rms_mm, self.keypoints_max_mm, ""),
        )
        lines = [
            f"  {name:18}{rms:.3f} mm rms, {most:.3f} mm at most" + (f"; {more}" if more else "")
            for name, rms, most, more in rows
        ]
        lines.append(
            f"  {'observed':18}{self.observed_rms_mm:.3f} mm rms, "
            f"{self.observed_deviation_mm:.3f} mm stated; {self.observed_share:.1%} of the frame"
        )
        lines.append(
            f"  {'depth':18}{self.depth_error_mm:.3f} mm rms, {self.depth_deviation_mm:.3f} mm stated"
        )
        ended = "converged" if self.placed.result.converged else "not converged"
        lines.append(f"  {'registration':18}{self.seconds:.1f} s, {ended}")
        return "\n".join([f"error against the ground truth ({heads[self.head]}):", *lines])


def compare_with_wearer(placed: PlacedFrame, person: Wearer, head: Head = "fitted") -> GlassesDemoReport:
    """Return the errors of a registered synthetic frame."""
    result, glasses = placed.result, person.glasses
    # Reading a mesh may drop and renumber vertices.
    same = cKDTree(glasses.rest_vertices).query(placed.given.frame.vertices)[1]
    error = np.linalg.norm(result.vertices - person.vertices[same], axis=1)
    seen, observed = person.seen[same], result.observed
    off = result.keypoints - person.keypoints
    marks = np.linalg.norm(off, axis=1)
    return GlassesDemoReport(
        placed=placed,
        head=head,
        seen_rms_mm=_rms(error[seen]),
        seen_max_mm=float(error[seen].max()),
        seen_share=float(seen.mean()),
        all_rms_mm=_rms(error),
        all_max_mm=float(error.max()),
        observed_rms_mm=_rms(error[observed]),
        observed_share=float(observed.mean()),
        observed_deviation_mm=_rms(result.deviation[observed]),
        keypoints_rms_mm=_rms(marks),
        keypoints_max_mm=float(marks.max()),
        depth_error_mm=_depth_error(person, off),
        depth_deviation_mm=result.depth_deviation,
        seconds=placed.seconds,
    )


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")


def _depth_error(person: Wearer, off: FloatArray) -> float:
    """Return the root mean square error (20, 3) along the rays of visible key points, least of all views."""
    errors = []
    for center, hidden in zip(camera_centers(person.cameras), person.hidden, strict=True):
        shown = ~hidden[person.glasses.keypoint_vertices]
        rays = normalized(person.keypoints[shown] - center)
        errors.append(_rms(np.einsum("ki,ki->k", rays, off[shown])))
    return float(np.nanmin(errors))
