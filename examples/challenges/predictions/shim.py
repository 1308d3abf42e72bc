"""Runs the evaluate() of main.py, written for EvalAI's own workers, and makes result.json of what it returns. Copy it as it is."""
import csv, importlib, json, math, os, traceback
from pathlib import Path

# Outside of `try`: a variable that is missing is the host's fault, and so is a script that cannot be imported.
ANNOTATIONS, FILE = os.environ["ANNOTATIONS"], os.path.join(os.environ["INPUT"], "file")
PHASE, RESULT = os.environ.get("PHASE_CODENAME", os.environ["TRACK"]), Path(os.environ["RESULTS"], "result.json")
script = importlib.import_module(os.environ.get("SCRIPT", "main"))
# Raised by a script that reads a wrong file, and its own OF_THE_FILE. UnicodeError and the parse errors of json and pandas are ValueErrors.
OF_THE_FILE = (ValueError, KeyError, TypeError, IndexError, AssertionError, csv.Error, *getattr(script, "OF_THE_FILE", ()))

def write(**fields):  # renamed into place: a reader finds the old file or the new one, never a part
    part = RESULT.with_name(".result.json")
    part.write_text(json.dumps({"schema": 1, "total": 1, **fields}))
    part.replace(RESULT)

def refuse(why):
    write(done=0, final=False, splits=[], refused=why)

def splits(result):  # [{"split": {"metric": 1.0}}, ...]
    each = [item for one in result for item in one.items()]
    return [{"name": name, "metrics": {key: float(value) for key, value in metrics.items()}} for name, metrics in each]

try:
    output = script.evaluate(ANNOTATIONS, FILE, PHASE, submission_metadata={})
except OF_THE_FILE as error:  # the participant's; all else is the host's, and ends this program with 1
    traceback.print_exc()
    refuse(f"{type(error).__name__}: " + str(error).strip().split("\n")[0])
else:
    found, shown = splits(output["result"]), output.get("submission_result")
    odd = [key for one in found for key, value in one["metrics"].items() if not math.isfinite(value)]
    if odd:
        refuse(f"these metrics of the file are no finite numbers: {', '.join(odd)}")
    else:
        write(done=1, final=True, splits=found, message=json.dumps(shown, default=str)[:1024] if shown else None)
