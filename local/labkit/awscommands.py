"""Owns whether a line of the `aws` program is one that it would take: service, operation, options and `--query`, by AWS's own models.

Runs as a program in the lab's virtual environment, which has the models: reads a JSON list of lines, each a list of words without the
`aws`, and prints a JSON list of what is wrong with each, empty where nothing is. Nothing is sent anywhere.
"""

import json
import sys
from collections.abc import Sequence
from typing import Any

import botocore.session
import jmespath
from botocore import xform_name

EVERYWHERE = {"region", "query", "output", "profile", "endpoint-url"}
# Commands of the program's own, which are no operation of a service: how many words without a name they take, and their options.
OWN = {
    ("s3", "cp"): (2, {"recursive", "exclude", "include", "no-sign-request"}),
    ("ecr", "get-login-password"): (0, set()),
    ("cloudformation", "deploy"): (
        0,
        {"stack-name", "template-file", "parameter-overrides", "capabilities", "no-fail-on-empty-changeset"},
    ),
}


def faults(words: Sequence[str]) -> list[str]:
    """What is wrong with one line."""
    if len(words) < 2:
        return ["no service and operation"]
    service, operation, *rest = words
    plain, options = split(rest)
    found = [fault for name, values in options.items() if name == "query" for fault in of_query(values)]
    if (service, operation) in OWN:
        count, names = OWN[service, operation]
        if len(plain) != count:
            found.append(f"{len(plain)} words without an option, not {count}")
        return found + [f"no option --{name}" for name in sorted(options.keys() - EVERYWHERE - names)]
    if plain:
        found.append(f"words without an option: {' '.join(plain)}")
    return found + of_operation(service, operation, {name: options[name] for name in options.keys() - EVERYWHERE})


def split(rest: Sequence[str]) -> tuple[list[str], dict[str, list[str]]]:
    """The words before the first option, and those of each option."""
    plain: list[str] = []
    options: dict[str, list[str]] = {}
    values = plain
    for word in rest:
        # A lone `-` is the standard output.
        if word.startswith("--"):
            name, equals, value = word[2:].partition("=")
            values = options.setdefault(name, [])
            values += [value] if equals else []
        else:
            values.append(word)
    return plain, options


def of_query(values: Sequence[str]) -> list[str]:
    try:
        jmespath.compile(" ".join(values))
    except jmespath.exceptions.JMESPathError as error:
        return [f"--query: {str(error).splitlines()[0]}"]
    return []


def of_operation(service: str, operation: str, options: dict[str, list[str]]) -> list[str]:
    """What differs from the model of the service."""
    session = botocore.session.get_session()
    if service not in session.get_available_services():
        return [f"no service {service}"]
    model = session.get_service_model(service)
    names = {xform_name(name, "-"): name for name in model.operation_names}
    if operation not in names:
        return [f"{service} has no operation {operation}"]
    shape = model.operation_model(names[operation]).input_shape
    members: dict[str, Any] = {xform_name(name, "-"): of for name, of in shape.members.items()} if shape else {}
    members |= {f"no-{name}": of for name, of in members.items() if of.type_name == "boolean"}
    needed = {xform_name(name, "-") for name in shape.required_members} if shape else set()
    found = [f"no option --{name}" for name in sorted(options.keys() - members.keys())]
    found += [f"--{name} is missing" for name in sorted(needed - options.keys())]
    for name in sorted(options.keys() & members.keys()):
        found += of_value(name, options[name], members[name])
    return found


def of_value(name: str, values: Sequence[str], member: Any) -> list[str]:
    """What is wrong with an option's words, as far as the model names the ones that there are."""
    is_list = member.type_name == "list"
    if not values and member.type_name != "boolean" or len(values) > 1 and not is_list:
        return [f"--{name} with {len(values)} words"]
    kinds = getattr(member.member if is_list else member, "enum", [])
    return [f"--{name}: there is no {value}" for value in values if kinds and value not in kinds]


if __name__ == "__main__":
    print(json.dumps([faults(line) for line in json.load(sys.stdin)]))
