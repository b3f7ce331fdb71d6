"""What the pipeline makes of a scan before it looks at its colours."""

from scan2albedo import AnnotatedFaceModel, RawScan, fit, register
from scan2albedo.fitting import FitOptions, FittedFace


def fitted_face(
    scan: RawScan, model: AnnotatedFaceModel | None = None, options: FitOptions = FitOptions()
) -> FittedFace:
    """Return a model, the default one when None, registered with a scan and fitted to it."""
    model = model or AnnotatedFaceModel.default()
    return fit(scan, model, register(scan, model), options=options)
