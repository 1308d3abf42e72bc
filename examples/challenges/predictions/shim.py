"""Runs the evaluate() of main.py, written for EvalAI's own workers, and makes result.json of what it returns. Copy it as it is."""
import csv, json, os, traceback
from pathlib import Path

from main import evaluate

# Raised by a script that reads a wrong file. UnicodeError and the parse errors of json and pandas are ValueErrors.
OF_THE_FILE = (ValueError, KeyError, TypeError, IndexError, AssertionError, csv.Error)

def write(**fields):  # renamed into place: a reader finds the old file or the new one, never a part
    part = Path(os.environ["RESULTS"], ".result.json")
    part.write_text(json.dumps({"schema": 1, "total": 1, "final": True, **fields}))
    part.replace(part.with_name("result.json"))

def splits(result):  # [{"split": {"metric": 1.0}}, ...]
    each = [item for one in result for item in one.items()]
    return [{"name": name, "metrics": {key: float(value) for key, value in metrics.items()}} for name, metrics in each]

try:
    output = evaluate(
        os.environ["ANNOTATIONS"],
        os.path.join(os.environ["INPUT"], "file"),
        os.environ.get("PHASE_CODENAME", os.environ["TRACK"]),
        submission_metadata={},
    )
except OF_THE_FILE as error:  # the participant's; all else is the host's, and ends this program with 1
    traceback.print_exc()
    first = str(error).strip().split("\n")[0]
    write(done=0, splits=[], refused=f"{type(error).__name__}: {first}")
else:
    shown = output.get("submission_result")
    write(done=1, splits=splits(output["result"]), message=json.dumps(shown, default=str)[:1024] if shown else None)
