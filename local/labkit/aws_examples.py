"""Owns what only the lab's virtual environment can tell of examples/aws: it has YAML, AWS's models of its services, and boto3.

Runs there as a program, and prints JSON: `yaml FILE…`, `operations SERVICE…`, or `deploy FOLDER`. AWS's packages are loaded where they are
needed: that takes longer than to read YAML, which is most of what is asked.
"""

import json
import sys
from pathlib import Path
from typing import Any

import yaml

# Template by template, as docs/aws.md makes them; the stand-in has no network to connect to.
STACKS = {
    "queue": {"Name": "challenge-1-production"},
    "leaderboard": {"Name": "leaderboard-20", "BucketPrefix": "my-challenge", "LogDays": "30"},
    "registry": {"Prefix": "leaderboard"},
}


def documents(files: list[str]) -> dict[str, list[Any]]:
    return {file: list(yaml.safe_load_all(Path(file).read_text())) for file in files}


def operations(services: list[str]) -> dict[str, list[str]]:
    """Each service's operations, named as the methods of a client."""
    import botocore.session  # noqa: PLC0415
    from botocore import xform_name  # noqa: PLC0415

    session = botocore.session.get_session()
    models = {service: session.get_service_model(service) for service in services}
    return {service: [xform_name(name) for name in model.operation_names] for service, model in models.items()}


def deploy(folder: str) -> dict[str, Any]:
    """Makes the stacks, and prints what is there then."""
    import boto3  # noqa: PLC0415

    formation = boto3.client("cloudformation")
    for name, parameters in STACKS.items():
        given = [{"ParameterKey": key, "ParameterValue": value} for key, value in parameters.items()]
        body = (Path(folder) / f"{name}.yaml").read_text()
        formation.create_stack(StackName=name, TemplateBody=body, Parameters=given)
        formation.get_waiter("stack_create_complete").wait(StackName=name, WaiterConfig={"Delay": 1, "MaxAttempts": 30})
    return {
        "queues": queues(boto3.client("sqs")),
        "keys": boto3.client("dynamodb").describe_table(TableName="leaderboard-20")["Table"]["KeySchema"],
        "groups": boto3.client("logs").describe_log_groups()["logGroups"],
        "encryption": boto3.client("s3").get_bucket_encryption(Bucket="my-challenge-leaderboard-20")[
            "ServerSideEncryptionConfiguration"
        ],
        "repositories": [
            found["repositoryName"] for found in boto3.client("ecr").describe_repositories()["repositories"]
        ],
    }


def queues(sqs: Any) -> dict[str, dict[str, str]]:
    urls = sqs.list_queues().get("QueueUrls", [])
    attributes = {url: sqs.get_queue_attributes(QueueUrl=url, AttributeNames=["All"])["Attributes"] for url in urls}
    return {url.rpartition("/")[2]: found for url, found in attributes.items()}


def main(arguments: list[str]) -> None:
    match arguments:
        case ["yaml", *files]:
            found: Any = documents(files)
        case ["operations", *services]:
            found = operations(services)
        case ["deploy", folder]:
            found = deploy(folder)
        case _:
            raise SystemExit("usage: yaml FILE... | operations SERVICE... | deploy FOLDER")
    print(json.dumps(found, default=str))


if __name__ == "__main__":
    main(sys.argv[1:])
