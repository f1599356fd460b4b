#!/usr/bin/env python3
"""Holds twin.json files to docs/twin.schema.json: tests/check_twin.py TWIN.json...

With the part of JSON schema that the schema uses, so that no package is needed; `--jsonschema` does it with the package of
that name instead. Prints the first fault of each file; exit code 1 where there is one.
"""
import json
import pathlib
import sys

SCHEMA = json.loads((pathlib.Path(__file__).resolve().parent.parent / "docs/twin.schema.json").read_text())
KINDS = {"object": dict, "array": list, "string": str, "boolean": bool, "null": type(None)}
WORDS = {"$schema", "$defs", "$ref", "title", "description", "type", "const", "enum", "required", "properties", "items", "minItems",
         "additionalProperties", "maxItems", "minimum", "maximum", "exclusiveMinimum", "minLength"}


def is_kind(value, kind):
    if kind in ("number", "integer"):
        return isinstance(value, (int, float)) and not isinstance(value, bool) and (kind == "number" or value == int(value))
    return isinstance(value, KINDS[kind])


def faults(value, schema, where):
    """Yields what is wrong with a value, with its place."""
    if isinstance(schema, bool):
        if not schema:
            yield f"{where}: is not in the schema"
        return
    assert set(schema) <= WORDS, f"the checker does not know {set(schema) - WORDS}"
    if "$ref" in schema:
        yield from faults(value, SCHEMA["$defs"][schema["$ref"].removeprefix("#/$defs/")], where)
    kinds = schema.get("type", [])
    if kinds and not any(is_kind(value, kind) for kind in ([kinds] if isinstance(kinds, str) else kinds)):
        yield f"{where}: {str(value)[:40]!r} is no {kinds}"
        return
    if "const" in schema and value != schema["const"] or "enum" in schema and value not in schema["enum"]:
        yield f"{where}: {value!r} is not allowed"
    if is_kind(value, "number"):
        if value < schema.get("minimum", value) or value > schema.get("maximum", value):
            yield f"{where}: {value} is out of range"
        if value <= schema.get("exclusiveMinimum", value - 1):
            yield f"{where}: {value} is not above {schema['exclusiveMinimum']}"
    if isinstance(value, str) and len(value) < schema.get("minLength", 0):
        yield f"{where}: is too short"
    if isinstance(value, list):
        if not schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value)):
            yield f"{where}: has {len(value)} entries"
        for i, entry in enumerate(value):
            yield from faults(entry, schema.get("items", True), f"{where}[{i}]")
    if isinstance(value, dict):
        for key in schema.get("required", []):
            if key not in value:
                yield f"{where}: has no {key}"
        for key, entry in value.items():
            yield from faults(entry, schema.get("properties", {}).get(key, schema.get("additionalProperties", True)), f"{where}.{key}")


def main(names):
    bad = False
    for name in names:
        document = json.loads(pathlib.Path(name).read_text())
        found = next(faults(document, SCHEMA, "twin"), None)
        if found:
            print(f"{name}: {found}")
            bad = True
    return bad


if __name__ == "__main__":
    if sys.argv[1:2] == ["--jsonschema"]:
        import jsonschema
        for each in sys.argv[2:]:
            jsonschema.Draft202012Validator(SCHEMA).validate(json.loads(pathlib.Path(each).read_text()))
        sys.exit(0)
    sys.exit(main(sys.argv[1:]))
