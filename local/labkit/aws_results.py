"""Owns the reading of what a run has left in S3 and DynamoDB. Changes nothing.

Runs in the lab's virtual environment (boto3), as a program: `BUCKET PREFIX TABLE PARTITION SORT`; prints one JSON object
`{objects: {key: bytes}, texts: {key: text}, row: {column: value} | null}`, keys without the prefix.
"""

import json
import sys
from typing import Any

from .aws_resources import client

# What is compared or shown; all of them are small.
TEXTS = ("agent/agent_results.json", "evalai/results.json", "evalai/stdout.txt", "logcopy/report.json")


def objects(bucket: str, prefix: str) -> dict[str, int]:
    pages = client("s3").get_paginator("list_objects_v2").paginate(Bucket=bucket, Prefix=prefix)
    return {found["Key"].removeprefix(prefix): found["Size"] for page in pages for found in page.get("Contents", [])}


def texts(bucket: str, prefix: str, keys: list[str]) -> dict[str, str]:
    s3 = client("s3")
    return {key: s3.get_object(Bucket=bucket, Key=prefix + key)["Body"].read().decode() for key in keys}


def row(table: str, partition: str, sort: str) -> dict[str, str] | None:
    """The row of one run; the names of its keys are the table's own."""
    dynamodb = client("dynamodb")
    schema = dynamodb.describe_table(TableName=table)["Table"]["KeySchema"]
    names = {key["KeyType"]: key["AttributeName"] for key in schema}
    key = {names["HASH"]: {"S": partition}, names["RANGE"]: {"S": sort}}
    item: dict[str, Any] | None = dynamodb.get_item(TableName=table, Key=key, ConsistentRead=True).get("Item")
    return None if item is None else {column: str(next(iter(value.values()))) for column, value in item.items()}


def main(arguments: list[str]) -> None:
    bucket, prefix, table, partition, sort = arguments
    found = objects(bucket, prefix)
    present = [key for key in TEXTS if key in found]
    answer = {"objects": found, "texts": texts(bucket, prefix, present), "row": row(table, partition, sort)}
    print(json.dumps(answer))


if __name__ == "__main__":
    main(sys.argv[1:])
