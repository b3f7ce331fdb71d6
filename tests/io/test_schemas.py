import json
import runpy
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_schemas_are_current_and_each_has_its_record():
    builder = runpy.run_path(str(ROOT / "tools" / "build" / "schemas.py"))
    built = {name: json.loads(text) for name, text in builder["schema_texts"]().items()}
    files = (ROOT / "data_schemas").iterdir()
    stored = {file.name: json.loads(file.read_text(encoding="utf-8")) for file in files}
    assert stored == built, "run python tools/build schemas"
