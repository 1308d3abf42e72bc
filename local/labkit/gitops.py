"""Owns how other programs read examples/gitops: Argo CD's Lua, Flux's CEL, and the schemas of External Secrets and Kueue.

Runs as a program in the environment of `requirements-examples.txt`, and prints JSON: `health PROGRAM FILE` for the objects on its
standard input, or `faults SCHEMAS FILE...`. The Lua has no more of the standard library than Argo CD gives it. Flux's order, and its rule
on `observedGeneration`, are those of runtime/cel/status_evaluator.go in fluxcd/pkg.
"""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import celpy
import jsonschema
import yaml
from celpy.adapter import json_to_cel
from lupa.lua51 import LuaRuntime

PREFIX = "resource.customizations.health."
# What Argo CD's sandbox lacks of Lua.
CLOSED = ("io", "string", "debug", "package", "require", "math", "coroutine", "dofile", "loadfile", "python")


def documents(file: str) -> list[Any]:
    return [one for one in yaml.safe_load_all(Path(file).read_text()) if one]


def argo(file: str) -> Callable[[Any], dict[str, str]]:
    """The health of an object, by the scripts in a ConfigMap of Argo CD."""
    scripts = {key: text for one in documents(file) for key, text in one.get("data", {}).items()}

    def health(found: Any) -> dict[str, str]:
        lua = LuaRuntime(register_eval=False, unpack_returned_tuples=True)
        for name in CLOSED:
            lua.globals()[name] = None
        lua.globals()["obj"] = lua.table_from(found, recursive=True)
        group = found["apiVersion"].partition("/")[0]
        return dict(lua.execute(scripts[f"{PREFIX}{group}_{found['kind']}"]))

    return health


def flux(file: str) -> Callable[[Any], dict[str, str]]:
    """The status of an object, by the expressions in a Kustomization of Flux."""
    checks = {
        (one["apiVersion"], one["kind"]): one
        for document in documents(file)
        for one in document.get("spec", {}).get("healthCheckExprs", [])
    }

    def health(found: Any) -> dict[str, str]:
        generation = found.get("status", {}).get("observedGeneration", found["metadata"]["generation"])
        if generation != found["metadata"]["generation"]:
            return {"status": "InProgress"}
        check = checks[found["apiVersion"], found["kind"]]
        for field, status in (("inProgress", "InProgress"), ("failed", "Failed"), ("current", "Current")):
            if field in check and holds(check[field], found):
                return {"status": status}
        return {"status": "InProgress"}

    return health


def holds(expression: str, found: Any) -> bool:
    environment = celpy.Environment()
    program = environment.program(environment.compile(expression))
    # Flux waits on while an expression cannot be evaluated: an object without a status has none yet.
    try:
        return bool(program.evaluate({name: json_to_cel(value) for name, value in found.items()}))
    except celpy.CELEvalError:
        return False


def faults(schemas: str, files: list[str]) -> Iterator[str]:
    """What the schemas refuse; `unknown` names kinds that have none."""
    kinds = json.loads(Path(schemas).read_text())["kinds"]
    for file in files:
        for found in documents(file):
            kind = f"{found['apiVersion']} {found['kind']}"
            if kind not in kinds:
                yield f"unknown {kind}"
                continue
            validator = jsonschema.Draft202012Validator(strict(kinds[kind]))
            yield from (f"{kind}: {error.json_path}: {error.message}" for error in validator.iter_errors(found))


def strict(schema: Any) -> Any:
    """A schema that takes no property it does not name, as the API server with strict validation."""
    if isinstance(schema, list):
        return [strict(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    inner = {key: strict(value) for key, value in schema.items()}
    is_open = "additionalProperties" in schema or schema.get("x-kubernetes-preserve-unknown-fields")
    if isinstance(schema.get("properties"), dict) and schema.get("type") == "object" and not is_open:
        inner["additionalProperties"] = False
    return inner


def main(arguments: list[str]) -> None:
    match arguments:
        case ["health", program, file] if program in ("argo", "flux"):
            health = {"argo": argo, "flux": flux}[program](file)
            found: Any = [health(one) for one in json.load(sys.stdin)]
        case ["faults", schemas, *files]:
            found = list(faults(schemas, files))
        case _:
            raise SystemExit("usage: health argo|flux FILE < OBJECTS | faults SCHEMAS FILE...")
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1:])
