"""Owns docs/reference: a page for each kind of the API, made from crds/. Pure but for these files.

A section for each object, a row for each field. What Kubernetes defines itself is named and not shown again.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from . import crdyaml, prose
from .errors import LabError

FOLDER = Path("docs/reference")
# Up to its full stop, of which code may hold others.
SENTENCE = re.compile(r"(?:`[^`]*`|[^`])*?[.!?](?: |$)")
BELOW = "See below."
MADE = "<!-- made from crds/ by `make chart-docs`: edit the types in crates/api, then run `make crds chart-docs` -->"
# The types of Kubernetes that occur, each by fields that no type of ours has.
KUBERNETES = {
    "EnvVar": {"name", "value", "valueFrom"},
    "ResourceRequirements": {"claims", "limits", "requests"},
    "SecurityContext": {"privileged", "seccompProfile", "windowsOptions"},
    "Toleration": {"effect", "operator", "tolerationSeconds"},
    "Condition": {"lastTransitionTime", "message", "observedGeneration", "reason", "status", "type"},
}
# The text of a field that has only the text of its type.
FOREIGN = "Time is a wrapper around time.Time"
INTRODUCTIONS = {
    "Leaderboard": (
        "Examples: [leaderboard-20.yaml](../../examples/leaderboard-20.yaml) for EvalAI and AWS,"
        " [leaderboard-local.yaml](../../examples/leaderboard-local.yaml) without either."
        " The reasons of its conditions are in [states.md](../states.md#a-leaderboards-conditions-ready-and-terminating)."
    ),
    "Submission": (
        "The bridge makes them of EvalAI's messages; [submission-local.yaml](../../examples/submission-local.yaml) is one made by hand."
        " The meaning of states and reasons is in [states.md](../states.md)."
    ),
}


def files(repository: Path) -> Iterator[tuple[Path, str]]:
    """Each page and what it has to hold."""
    for source in sorted((repository / "crds").glob("*.yaml")):
        definition = crdyaml.read(source.read_text(), source.name)
        yield FOLDER / f"{definition['spec']['names']['singular']}.md", page(definition)


def update(repository: Path) -> None:
    for file, text in files(repository):
        (repository / file).parent.mkdir(exist_ok=True)
        (repository / file).write_text(text)


def same(repository: Path) -> str:
    """For the chart's test: raises unless the pages are those of the definitions."""
    wanted = dict(files(repository))
    for file, text in wanted.items():
        if not (repository / file).exists() or (repository / file).read_text() != text:
            raise LabError(f"{file} differs from crds/: run `make chart-docs`")
    fields = sum(line.startswith("| `") for text in wanted.values() for line in text.splitlines())
    return f"{fields} fields"


def page(definition: dict[str, Any]) -> str:
    """The page of one kind."""
    spec = definition["spec"]
    names, [version] = spec["names"], spec["versions"]
    kind, schema = names["kind"], version["schema"]["openAPIV3Schema"]
    short = " and ".join(f"`kubectl get {name}`" for name in [names["plural"], *names["shortNames"]])
    columns, wide = (
        ", ".join(
            one["name"].upper() for one in version["additionalPrinterColumns"] if bool(one.get("priority")) is is_wide
        )
        for is_wide in (False, True)
    )
    lines = [
        f"# {kind}: all fields",
        "",
        MADE,
        "",
        f"`apiVersion: {spec['group']}/{version['name']}`, `kind: {kind}`, {spec['scope'].lower()}. {short} show {columns}."
        f"{f' With `-o wide` they also show {wide}.' if wide else ''}",
        "",
        INTRODUCTIONS[kind],
        "",
        "A field without a default may be left out, unless it is required. `kubectl explain` shows fields and texts on the command line.",
    ]
    lines += rules(schema)
    for part in ("spec", "status"):
        lines += sections(schema["properties"][part], part, 2)
    return "\n".join(lines) + "\n"


def sections(schema: dict[str, Any], path: str, level: int) -> Iterator[str]:
    """The section of one object, and those of the objects in it."""
    below = schema["properties"]
    yield from ("", f"{'#' * level} {path}", "", text_of(schema, path), "")
    yield from ("| field | type | default | meaning |", "|---|---|---|---|")
    required = schema.get("required", [])
    notes = []
    for name, field in below.items():
        default = "required" if name in required and path_is_asked(path) else default_of(field)
        text, rest = fitting(meaning(field, f"{path}.{name}"))
        notes += [f"- `{name}`: {rest}"] if rest else []
        yield f"| `{name}` | {type_of(field, f'{path}.{name}')} | {default} | {text} |"
    yield from ["", "More of these fields:", "", *notes] if notes else []
    yield from rules(schema)
    for name, field in below.items():
        inner, inner_path = unwrapped(field, f"{path}.{name}")
        if own(inner):
            yield from sections(inner, inner_path, 3)


def path_is_asked(path: str) -> bool:
    """Nobody writes a status by hand, so nothing of it is required of anybody."""
    return not path.startswith("status")


def unwrapped(field: dict[str, Any], path: str) -> tuple[dict[str, Any], str]:
    """What a list or a map holds, with its path; anything else as it is."""
    if "items" in field:
        return unwrapped(field["items"], f"{path}[]")
    if isinstance(field.get("additionalProperties"), dict):
        return unwrapped(field["additionalProperties"], f"{path}{{}}")
    return field, path


def own(schema: dict[str, Any]) -> bool:
    return "properties" in schema and of_kubernetes(schema) is None


def of_kubernetes(schema: dict[str, Any]) -> str | None:
    """The name of the type, if Kubernetes defines it."""
    fields = schema.get("properties", {}).keys()
    return next((name for name, known in KUBERNETES.items() if known <= fields), None)


def type_of(field: dict[str, Any], path: str) -> str:
    if "items" in field:
        return f"list of {type_of(field['items'], f'{path}[]')}"
    if isinstance(field.get("additionalProperties"), dict):
        return f"map of {type_of(field['additionalProperties'], f'{path}{{}}')}"
    if name := of_kubernetes(field):
        return f"`{name}` of Kubernetes"
    if "properties" in field:
        return f"[object](#{anchor(path)})"
    if field.get("format") == "date-time":
        return "time"
    if field.get("x-kubernetes-int-or-string"):
        return "integer or string"
    return str(field["type"])


def anchor(path: str) -> str:
    """As GitHub and mdBook make it of a heading."""
    return "".join(letter for letter in path.lower() if letter.isalnum() or letter in "-_ ").replace(" ", "-")


def default_of(field: dict[str, Any]) -> str:
    if "default" not in field:
        return ""
    value = field["default"]
    if isinstance(value, dict):
        return "those below" if value else "`{}`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{value}`" if value != "" else '`""`'


def meaning(field: dict[str, Any], path: str) -> str:
    """The text of a field and what it may hold."""
    inner, _ = unwrapped(field, path)
    parts = [text_of(field, path), *limits(field)]
    if inner is not field:
        parts += [f"Each: {limit[0].lower()}{limit[1:]}" for limit in limits(inner)]
    if inner is field or not own(inner):
        parts += [f"{message(rule)}" for rule in inner.get("x-kubernetes-validations", []) if not own(field)]
    return " ".join(parts)


def fitting(text: str) -> tuple[str, str]:
    """What a cell can hold of a text, sentence by sentence, and the rest, which stands below the table."""
    if len(prose.seen(text)) <= prose.CELL:
        return text, ""
    kept, rest = "", text
    while sentence := SENTENCE.match(rest):
        if len(prose.seen(kept + sentence[0] + BELOW)) > prose.CELL:
            break
        kept, rest = kept + sentence[0], rest[sentence.end() :]
    return kept + BELOW, rest


def text_of(field: dict[str, Any], path: str) -> str:
    text = " ".join(field.get("description", "").split())
    if not text or text.startswith(FOREIGN):
        raise LabError(f"{path} has no text: write a comment at its field in crates/api, then run `make crds`")
    return escaped(text if text.endswith((".", "!", "?")) else f"{text}.")


def limits(field: dict[str, Any]) -> Iterator[str]:
    """What the definition allows of a value, a sentence for each."""
    if "enum" in field:
        yield f"One of {', '.join(f'`{one}`' for one in field['enum'] if one is not None)}."
    yield from between(field.get("minimum"), field.get("maximum"), "")
    yield from between(field.get("minLength"), field.get("maxLength"), " characters")
    yield from between(field.get("minItems"), field.get("maxItems"), " entries")
    yield from between(field.get("minProperties"), field.get("maxProperties"), " entries")
    if "pattern" in field:
        yield f"Pattern `{field['pattern'].replace('|', chr(92) + '|')}`."


def between(least: int | None, most: int | None, unit: str) -> Iterator[str]:
    if least is not None and most is not None:
        yield f"{least} to {most}{unit}."
    elif least is not None:
        yield f"At least {least}{unit}."
    elif most is not None:
        yield f"At most {most}{unit}."


def rules(schema: dict[str, Any]) -> list[str]:
    """What the API server refuses of an object, in the words that it answers with."""
    messages = [message(rule) for rule in schema.get("x-kubernetes-validations", [])]
    return (
        ["", "With these words the API server refuses an object:", "", *(f"- {one}" for one in messages)]
        if messages
        else []
    )


def message(rule: dict[str, Any]) -> str:
    return escaped(" ".join(rule["message"].split()))


def escaped(text: str) -> str:
    """For a cell of a table. Between backticks Markdown itself leaves everything but the bar alone."""
    parts = text.replace("|", "\\|").split("`")
    outside = [
        part.replace("<", "&lt;").replace("*", "\\*") if number % 2 == 0 else part for number, part in enumerate(parts)
    ]
    return "`".join(outside)
