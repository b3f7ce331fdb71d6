"""Recognition of persons by their albedo: templates, similarity, identification and its curves."""

from scan2albedo.recognition.curves import CmcCurve, RocCurve, cmc_curve, roc_curve
from scan2albedo.recognition.identification import Identification, identify, identify_by_similarity
from scan2albedo.recognition.labelled_templates import (
    LabelledTemplates,
    read_labelled_templates,
    read_templates,
    write_labelled_templates,
    write_templates,
)
from scan2albedo.recognition.manifest import Manifest, ManifestEntry, StoredFace, read_face, read_manifest
from scan2albedo.recognition.result_identification import (
    Calibration,
    ResultIdentification,
    fused,
    identify_results,
    same_person_log_odds,
)
from scan2albedo.recognition.similarity import cw_ssim, similarity_matrix
from scan2albedo.recognition.templates import (
    Chart,
    TemplateOptions,
    Templates,
    albedo_templates,
    certainty,
    shape_templates,
)

__all__ = [
    "Calibration",
    "Chart",
    "CmcCurve",
    "Identification",
    "LabelledTemplates",
    "Manifest",
    "ManifestEntry",
    "ResultIdentification",
    "RocCurve",
    "StoredFace",
    "TemplateOptions",
    "Templates",
    "albedo_templates",
    "certainty",
    "cmc_curve",
    "cw_ssim",
    "fused",
    "identify",
    "identify_by_similarity",
    "identify_results",
    "read_face",
    "read_labelled_templates",
    "read_manifest",
    "read_templates",
    "roc_curve",
    "same_person_log_odds",
    "shape_templates",
    "similarity_matrix",
    "write_labelled_templates",
    "write_templates",
]
