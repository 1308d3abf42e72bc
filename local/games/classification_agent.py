"""Agents of the classification that cheat, disturb or fail, for tests. KIND names one, else the track does; README.md here lists them.

Where its kind says nothing else, each predicts as examples/challenges/classification/agent.py does, so that its score shows what it has
gained.
"""

import csv
import json
import os
import runpy
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

DATASET, SUBMISSION = Path(os.environ["DATASET"]), Path(os.environ["SUBMISSION_PATH"])
PREDICTIONS = SUBMISSION / "predictions.csv"
EXAMPLE = os.environ.get("EXAMPLE", "/example.py")
# What is in here outlives the container.
FOLDER = Path(os.environ.get("FOLDER", "/tmp/agent"))
# Below this folder `search` looks.
ROOT = os.environ.get("ROOT", "/")
# What the system shows of itself.
SYSTEM = ("/proc", "/sys")
# What the evaluators have and an agent has not.
SECRET = {"collected.json", "evaluator.py", "evaluators", "labels", "labels.csv", "result.json", "rows.json"}
VARIABLES = ("INPUT", "LABELS", "RESULTS", "RESUME", "WORKER", "EVALUATOR_ADDRESS")
# So long after its marks an agent that forges is still there: what begins by a mark begins meanwhile.
LINGERS = 2


def predict() -> None:
    runpy.run_path(EXAMPLE, run_name="__main__")


def predict_blindly() -> None:
    """Gives each row the same category."""
    with (DATASET / "test.csv").open(newline="") as text:
        rows = [(row["id"], "Lo") for row in csv.DictReader(text)]
    with PREDICTIONS.open("w", newline="") as text:
        csv.writer(text).writerows([("id", "category"), *rows])


def folders() -> Iterator[Path]:
    for folder, names, _ in os.walk(ROOT):
        names[:] = [name for name in names if os.path.join(folder, name) not in SYSTEM]
        yield Path(folder)


def listed(folder: Path) -> list[Path]:
    with suppress(OSError):
        return list(folder.iterdir())
    return []


def crash_once() -> None:
    """Leaves a part and exits with 1; the next life predicts."""
    mark = FOLDER / "began"
    if not mark.exists():
        mark.write_text("1\n")
        PREDICTIONS.write_text("id,category\n")
        print("crashes", flush=True)
        sys.exit(1)
    predict()


def hang() -> None:
    """Prints and does nothing."""
    print("waits", flush=True)
    signal.pause()


def link_labels() -> None:
    """Leaves a link in place of the predictions: it would be a perfect score."""
    PREDICTIONS.symlink_to("/labels/labels.csv")


def link_dataset() -> None:
    """Predicts, and leaves a link to a folder that it can read beside that."""
    predict()
    (SUBMISSION / "data").symlink_to(DATASET)


def sparse() -> None:
    """Leaves ten gigabytes that take no place."""
    with PREDICTIONS.open("wb") as file:
        file.truncate(10 << 30)


def many() -> None:
    """Leaves 1001 files."""
    for number in range(1001):
        (SUBMISSION / f"{number:04}.csv").write_text("id,category\n")


def fifo() -> None:
    """Leaves a pipe, from which a reader would never get a byte."""
    os.mkfifo(PREDICTIONS)


def forge() -> None:
    """Predicts blindly, then writes into each folder that it can write to that all is done, with the best score."""
    if not Path("/tmp/status").is_dir():
        sys.exit("this agent writes into every folder, and belongs into a Pod")
    predict_blindly()
    splits = [{"name": "test", "metrics": {"accuracy": 1.0}}]
    result = json.dumps({"schema": 1, "done": 100, "total": 100, "final": True, "splits": splits})
    marks = [f"{side}-{worker}.done" for side in ("agent", "evaluator") for worker in (1, 2)]
    files = dict.fromkeys([*marks, "logcopy.done"], "") | dict.fromkeys(
        ["result.json", "evaluators/1/result.json", "evaluators/2/result.json"], result
    )
    lists = ["collected.json", "logcopy/collected.json"]
    files |= dict.fromkeys(lists, json.dumps({"schema": 1, "files": {"predictions.csv": {"size": 0, "sha256": ""}}}))
    written = 0
    for folder in [Path("/results"), Path("/input"), *folders()]:
        for name, text in files.items():
            with suppress(OSError):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_text(text)
                written += 1
    print(f"forged: {written} files", flush=True)
    time.sleep(LINGERS)


def search() -> None:
    """Looks for labels, evaluators and their files, tries to change the dataset, prints what it has found, then predicts."""
    found = [f"variable {name}" for name in VARIABLES if name in os.environ]
    found += [str(path) for folder in folders() for path in listed(folder) if path.name in SECRET]
    found += [str(path) for name in ("labels", "results", "input") for path in listed(Path("/") / name)]
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            found += [str(process)] if b"evaluator.py" in (process / "cmdline").read_bytes() else []
    with suppress(OSError), (DATASET / "test.csv").open("a"):
        found.append("a dataset that it can change")
    print(f"found: {', '.join(found) or 'nothing'}", flush=True)
    predict()


KINDS = {
    "predict": predict,
    "crash-once": crash_once,
    "hang": hang,
    "link-labels": link_labels,
    "link-dataset": link_dataset,
    "sparse": sparse,
    "many": many,
    "fifo": fifo,
    "nothing": lambda: None,
    "forge": forge,
    "search": search,
}

KINDS[os.environ.get("KIND") or os.environ["TRACK"]]()
