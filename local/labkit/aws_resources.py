"""Owns what exists in the AWS stand-in, as a challenge's account would hold it; creates what is missing, changes nothing else.

Runs in the lab's virtual environment (boto3), as a program: `base CERTIFICATE_AUTHORITY API_SERVER` or `repositories NAME…`;
`quickstart` is for the one in a Pod of examples/quickstart.yaml.
"""

import json
import os
import sys
from collections.abc import Callable
from typing import Any

import boto3
from botocore.config import Config
from botocore.exceptions import ClientError

QUEUE = "submissions"
DEAD_LETTERS = "submissions-dead"
NAME = "leaderboard-20"
REGION = "us-east-1"
# table -> (partition key, sort key): the pipeline's stack writes them with a low line, the documents with a hyphen.
TABLES = {NAME: ("team_id", "submission_id"), f"{NAME}-hyphen": ("team-id", "submission-id")}
PHASES = {"1": f"{NAME}-SENSORS", "2": f"{NAME}-MAP"}


def client(service: str) -> Any:
    return boto3.client(service, config=Config(retries={"max_attempts": 1}))


def unless(code: str, create: Callable[..., object], **arguments: object) -> None:
    """Creates something; that it exists already (the error `code`) is fine."""
    try:
        create(**arguments)
    except ClientError as error:
        if error.response.get("Error", {}).get("Code") != code:
            raise


def queues() -> None:
    """The challenge's queue, whose messages are hidden for 30 s, and the one for those that nothing can be done with."""
    sqs = client("sqs")
    dead = sqs.create_queue(QueueName=DEAD_LETTERS)["QueueUrl"]
    arn = sqs.get_queue_attributes(QueueUrl=dead, AttributeNames=["QueueArn"])["Attributes"]["QueueArn"]
    redrive = json.dumps({"deadLetterTargetArn": arn, "maxReceiveCount": 20})
    attributes = {"VisibilityTimeout": "30", "RedrivePolicy": redrive}
    unless("QueueNameExists", sqs.create_queue, QueueName=QUEUE, Attributes=attributes)


def bucket() -> None:
    s3 = client("s3")
    if NAME not in [found["Name"] for found in s3.list_buckets()["Buckets"]]:
        s3.create_bucket(Bucket=NAME)


def tables() -> None:
    dynamodb = client("dynamodb")
    for name, keys in TABLES.items():
        schema = [{"AttributeName": key, "KeyType": kind} for key, kind in zip(keys, ("HASH", "RANGE"), strict=True)]
        types = [{"AttributeName": key, "AttributeType": "S"} for key in keys]
        unless(
            "ResourceInUseException",
            dynamodb.create_table,
            TableName=name,
            KeySchema=schema,
            AttributeDefinitions=types,
            BillingMode="PAY_PER_REQUEST",
        )


def secrets(authority: str, api_server: str) -> None:
    """The original's entries, with the stand-ins' values; an entry that exists keeps what a person put there."""
    evalai, registry = os.environ["LAB_EVALAI"], os.environ["LAB_REGISTRY"]
    entries = {
        "evalai": {"auth_token": "local-host-token", "api_server": evalai},
        "evalai-tracks": PHASES,
        NAME: {
            "name": "leaderboard-local",
            "endpoint": api_server,
            "certificate_authority": authority,
            "simulator_image": f"{registry}/challenge/simulator:1",
            "leaderboard_image": f"{registry}/challenge/contents:1",
            "logcopy_image": f"{registry}/leaderboard-operator:dev",
            "s3_bucket": NAME,
            "dynamodb_submissions_table": NAME,
            "cloudwatch_log_group": NAME,
        },
    }
    manager = client("secretsmanager")
    for name, value in entries.items():
        unless("ResourceExistsException", manager.create_secret, Name=name, SecretString=json.dumps(value))


def log_group() -> None:
    unless("ResourceAlreadyExistsException", client("logs").create_log_group, logGroupName=NAME)


def repositories(names: list[str]) -> None:
    ecr = client("ecr")
    for name in names:
        unless("RepositoryAlreadyExistsException", ecr.create_repository, repositoryName=name)


def main(arguments: list[str]) -> None:
    match arguments:
        case ["base", authority, api_server]:
            queues()
            bucket()
            tables()
            secrets(authority, api_server)
            log_group()
        case ["quickstart"]:
            queues()
            tables()
            log_group()
            # Last: that it is there shows that all is.
            bucket()
        case ["repositories", *names]:
            repositories(names)
        case _:
            raise SystemExit("usage: base CERTIFICATE_AUTHORITY API_SERVER | quickstart | repositories NAME...")


if __name__ == "__main__":
    main(sys.argv[1:])
