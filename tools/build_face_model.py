"""Rebuild the default face model that ships with the package, and the schema of model files.

python tools/build_face_model.py             overwrite scan2albedo/face_model/data/afm.json and afm.npz,
                                             and data_schemas/annotated_face_model.schema.json
python tools/build_face_model.py OUT.json    write the model elsewhere
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from scan2albedo.face_model.files import FaceModelFile, save_model
from scan2albedo.face_model.generator.build import build_face_model
from scan2albedo.geometry.parametrization import chart_distortion

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ROOT / "scan2albedo" / "face_model" / "data" / "afm.json"
SCHEMA = ROOT / "data_schemas" / "annotated_face_model.schema.json"


def schema_text() -> str:
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": SCHEMA.name}
    return json.dumps(head | FaceModelFile.model_json_schema(mode="serialization"), indent=2) + "\n"


def main(arguments: list[str]) -> None:
    target = Path(arguments[0]) if arguments else SHIPPED
    target.parent.mkdir(parents=True, exist_ok=True)
    if not arguments:
        SCHEMA.write_text(schema_text(), encoding="utf-8")
    model = build_face_model()
    save_model(model, target)
    vertices, faces = model.surface(0)
    print(f"{target}: {len(model.control_vertices)} control vertices, {len(model.control_faces)} faces")
    print(chart_distortion(vertices, faces, model.uv))


if __name__ == "__main__":
    main(sys.argv[1:])
