"""Files held against the JSON schemas that describe them."""

import json
from pathlib import Path

import jsonschema
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "data_schemas"


def check_schema(path, name, *wrong):
    """Return the tree of a file that fits the schema of that name, which each change of `wrong` breaks."""
    tree = json.loads(Path(path).read_text(encoding="utf-8"))
    rules = json.loads((FOLDER / f"{name}.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(rules)
    jsonschema.validate(tree, rules)
    for change in wrong:
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**tree, **change}, rules)
    return tree
