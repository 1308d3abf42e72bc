"""The scoring script of a challenge, as hosts write it for EvalAI's own workers."""
import csv

def read(file):
    with open(file, newline="", encoding="utf-8-sig") as text:  # spreadsheets begin a file with a mark
        return [(row["id"], row["category"]) for row in csv.DictReader(text)]

def evaluate(test_annotation_file, user_submission_file, phase_codename, **kwargs):
    print(f"Evaluating the phase {phase_codename}")
    labels, rows = dict(read(test_annotation_file)), read(user_submission_file)
    answers = dict(rows)
    if len(rows) != len(labels) or answers.keys() != labels.keys():
        raise ValueError(f"the file must have the {len(labels)} ids of test.csv, each once")
    metrics = {"accuracy": sum(answers[row] == labels[row] for row in labels) / len(labels)}
    return {"result": [{"test": metrics}], "submission_result": metrics}
