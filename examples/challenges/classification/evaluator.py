"""The evaluator of a classification: it counts how many categories in the agent's predictions.csv are right."""
import csv, json, os
from pathlib import Path

def read(file):
    with file.open(newline="", encoding="utf-8-sig") as text:  # spreadsheets begin a file with a mark
        return [(row["id"], row["category"]) for row in csv.DictReader(text)]

def write(**fields):  # renamed into place: a reader finds the old file or the new one, never a part
    part = Path(os.environ["RESULTS"], ".result.json")
    part.write_text(json.dumps({"schema": 1, **fields}))
    part.replace(part.with_name("result.json"))

labels = dict(read(Path(os.environ["LABELS"], "labels.csv")))
own = sorted(labels)[int(os.environ["WORKER"]) - 1 :: int(os.environ["WORKERS"])]  # this worker's share
try:
    rows = read(Path(os.environ["INPUT"], "predictions.csv"))
    answers = dict(rows)
    if len(rows) != len(labels) or answers.keys() != labels.keys():
        raise ValueError(f"it must have the {len(labels)} ids of test.csv, each once")
except (FileNotFoundError, IsADirectoryError, KeyError, ValueError, csv.Error) as error:  # the participant's fault
    refused = f"predictions.csv with the columns id and category is needed: {type(error).__name__}: {error}"
    write(done=0, total=len(own), final=False, splits=[], refused=refused)
else:
    metrics = {"accuracy": sum(answers[row] == labels[row] for row in own) / len(own)}
    write(done=len(own), total=len(own), final=True, splits=[{"name": "test", "metrics": metrics}])
