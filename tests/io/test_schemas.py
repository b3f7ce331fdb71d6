import json
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BUILDER = runpy.run_path(str(ROOT / "tools" / "build" / "schemas.py"))


@pytest.mark.parametrize("name", sorted(BUILDER["schema_texts"]()))
def test_schemas_are_current(name):
    stored = json.loads((ROOT / "data_schemas" / name).read_text(encoding="utf-8"))
    assert stored == json.loads(BUILDER["schema_texts"]()[name]), "run python tools/build schemas"


def test_every_schema_has_its_record():
    assert {p.name for p in (ROOT / "data_schemas").iterdir()} == set(BUILDER["schema_texts"]())
