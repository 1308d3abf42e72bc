"""Owns the way from an API server's OpenAPI document to the JSON schemas that kubeconform reads. Pure.

kubeconform's own schemas come from the internet; these come from the very server that the chart is for, and refuse what it does
not know.
"""

from collections.abc import Collection, Iterator
from typing import Any

REFERENCE = "#/definitions/"
# The document has "string" for these, and the server takes numbers too.
LENIENT = {
    "io.k8s.apimachinery.pkg.util.intstr.IntOrString": {"type": ["string", "integer"]},
    "io.k8s.apimachinery.pkg.api.resource.Quantity": {"type": ["string", "number"]},
}
# For `--schema-location`.
TEMPLATE = "{{.Group}}_{{.ResourceAPIVersion}}_{{.ResourceKind}}.json"


def files(openapi: dict[str, Any], kinds: Collection[str] | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
    """The name and content of one file for each kind in a document of OpenAPI v2, or for each of these names."""
    definitions = {name: strict(name, schema) for name, schema in openapi["definitions"].items()}
    for name, schema in openapi["definitions"].items():
        for kind in schema.get("x-kubernetes-group-version-kind", []):
            if kinds is not None and kind["kind"] not in kinds:
                continue
            # kubeconform takes the version for the group where there is no group.
            group = kind["group"] or kind["version"]
            file = f"{group}_{kind['version']}_{kind['kind'].lower()}.json"
            needed = {one: definitions[one] for one in closure(definitions, name)}
            yield file, {"$ref": REFERENCE + name, "definitions": needed}


def strict(name: str, schema: dict[str, Any]) -> dict[str, Any]:
    """A definition that takes no property it does not name."""
    if name in LENIENT:
        return LENIENT[name]
    is_open = schema.get("x-kubernetes-preserve-unknown-fields") or "additionalProperties" in schema
    if "properties" not in schema or is_open:
        return schema
    return schema | {"additionalProperties": False}


def closure(definitions: dict[str, dict[str, Any]], name: str) -> set[str]:
    """A definition and all that it refers to; some refer to themselves."""
    found, waiting = {name}, [name]
    while waiting:
        for other in references(definitions[waiting.pop()]):
            if other not in found:
                found.add(other)
                waiting.append(other)
    return found


def references(schema: Any) -> Iterator[str]:
    if isinstance(schema, dict):
        target = schema.get("$ref")
        if isinstance(target, str):
            yield target.removeprefix(REFERENCE)
        for value in schema.values():
            yield from references(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from references(value)
