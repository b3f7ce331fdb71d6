"""Rebuild the default face model that ships with the package.

python tools/build_face_model.py             overwrite scan2albedo/face_model/data/afm.json and afm.npz
python tools/build_face_model.py OUT.json    write the model elsewhere
"""

from __future__ import annotations

import sys
from pathlib import Path

from face_model_generator.build import build_face_model
from face_model_generator.chart_distortion import chart_distortion

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ROOT / "scan2albedo" / "face_model" / "data" / "afm.json"


def main(arguments: list[str]) -> None:
    target = Path(arguments[0]) if arguments else SHIPPED
    target.parent.mkdir(parents=True, exist_ok=True)
    model = build_face_model()
    model.save(target)
    vertices, faces = model.surface(0)
    print(f"{target}: {len(model.control_vertices)} control vertices, {len(model.control_faces)} faces")
    print(chart_distortion(vertices, faces, model.uv))


if __name__ == "__main__":
    main(sys.argv[1:])
