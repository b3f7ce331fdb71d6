"""Files of JSON, and the schemas that they keep to."""

import json
from pathlib import Path

import jsonschema

SCHEMAS = Path(__file__).resolve().parents[2] / "data_schemas"


def read_json(path):
    """Return what a file of JSON holds."""
    return json.loads(path.read_text())


def valid_record(path, schema):
    """Return what a file of JSON holds, which keeps to `data_schemas/<schema>.schema.json`."""
    record = read_json(path)
    jsonschema.validate(record, read_json(SCHEMAS / f"{schema}.schema.json"))
    return record


def files_in(folder):
    """Return the names of what is in a folder."""
    return {path.name for path in folder.iterdir()}
