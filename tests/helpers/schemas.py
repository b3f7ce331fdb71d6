"""Files held against the JSON schemas that describe them."""

import jsonschema
import pytest

from helpers.records import SCHEMAS, read_json, valid_record


def check_schema(path, name, *wrong):
    """Return the tree of a file that fits the schema of that name, which each change of `wrong` breaks."""
    rules = read_json(SCHEMAS / f"{name}.schema.json")
    jsonschema.Draft202012Validator.check_schema(rules)
    tree = valid_record(path, name)
    for change in wrong:
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**tree, **change}, rules)
    return tree
