"""Write the JSON Schemas of every file we read or write; --check only tells whether they are current."""

import json
from pathlib import Path

from pydantic import BaseModel

from scan2albedo.applications.light_sweep import SweepRecord
from scan2albedo.batch.records import BatchRecord, BatchScanRecord
from scan2albedo.eyeglasses.frame_files import KeyPointsFile, StartFile
from scan2albedo.eyeglasses.view_files import CamerasFile, LabelsFile
from scan2albedo.face_model.annotation import FaceModelFile
from scan2albedo.io.landmark_files import LandmarksRecord
from scan2albedo.io.result_records import (
    ApplicationRecord,
    LinearModelRecord,
    RegistrationRecord,
    ResultRecord,
)
from scan2albedo.recognition.labelled_templates import TemplatesHeader
from scan2albedo.reflectance.capture_files import FacePhotographFile, FlashCaptureFile
from scan2albedo.reflectance.morphable_model import ReflectanceModelHeader
from scan2albedo.reflectance.reflectance_files import MeshReflectanceHeader
from scan2albedo.reflectance.shape_model import ShapeModelHeader
from scan2albedo.runs.eyeglasses.canonicalize_run import CanonicalFrameRecord, CanonicalSetRecord
from scan2albedo.runs.eyeglasses.lenses_run import LensesRecord
from scan2albedo.runs.eyeglasses.register_run import RegisteredFrameRecord
from scan2albedo.runs.recognition import IdentificationRecord
from scan2albedo.runs.reflectance import ReflectanceRecord

FOLDER = Path(__file__).resolve().parents[2] / "data_schemas"

RECORDS: dict[str, type[BaseModel]] = {
    "result": ResultRecord,
    "registration": RegistrationRecord,
    "landmarks": LandmarksRecord,
    "coefficients": LinearModelRecord,
    "annotated_face_model": FaceModelFile,
    "application": ApplicationRecord,
    "sweep": SweepRecord,
    "batch": BatchRecord,
    "batch_scan": BatchScanRecord,
    "identification": IdentificationRecord,
    "cameras": CamerasFile,
    "canonical_eyeglasses": CanonicalFrameRecord,
    "canonical_eyeglasses_set": CanonicalSetRecord,
    "eyeglasses_keypoints": KeyPointsFile,
    "eyeglasses_labels": LabelsFile,
    "eyeglasses_start": StartFile,
    "registered_eyeglasses": RegisteredFrameRecord,
    "eyeglasses_lenses": LensesRecord,
    "template_set": TemplatesHeader,
    "reflectance_model": ReflectanceModelHeader,
    "reflectance_result": ReflectanceRecord,
    "mesh_reflectance": MeshReflectanceHeader,
    "flash_capture": FlashCaptureFile,
    "face_photograph": FacePhotographFile,
    "shape_model": ShapeModelHeader,
}


def schema_texts() -> dict[str, str]:
    """File name and text of every schema."""
    texts = {}
    for name, record in RECORDS.items():
        file = f"{name}.schema.json"
        head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": file}
        texts[file] = json.dumps(head | record.model_json_schema(mode="serialization"), indent=2) + "\n"
    return texts


def main(arguments: list[str]) -> None:
    stale = []
    FOLDER.mkdir(exist_ok=True)
    for name, text in schema_texts().items():
        file = FOLDER / name
        if not file.exists() or file.read_text(encoding="utf-8") != text:
            stale.append(name)
            if "--check" not in arguments:
                file.write_text(text, encoding="utf-8")
    if "--check" in arguments and stale:
        raise SystemExit(f"{', '.join(stale)} not current")
    print(f"{', '.join(stale) or 'no schema'} written")
