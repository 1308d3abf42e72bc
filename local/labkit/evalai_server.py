"""Owns the stand-in of EvalAI as a background process of the lab. Started by `demo` and the cluster's tests, ended by `lab down`.

It keeps everything in memory. So that submissions of two of its lives never share a key (their names in the cluster and their
prefixes in S3 follow from it), each life begins at the next thousand.
"""

import hashlib
import json
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

from . import cluster, process
from .components import PATH, Component, answers
from .errors import LabError
from .settings import HOST_ADDRESS, Settings, aws_environment

NAME = "evalai"
QUEUE = "submissions"
KEYS_PER_LIFE = 1000
# Nothing of the lab is asked of a proxy.
DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def component(settings: Settings, program: Path) -> Component:
    """The process, listening where Pods reach it and on the loopback address, for people."""
    port = settings.ports["evalai"]
    listens = [(HOST_ADDRESS, port), ("127.0.0.1", port)]
    argv = [str(program), "serve", *(f"--listen={address}:{number}" for address, number in listens)]
    argv += [f"--sqs-endpoint={settings.aws_endpoint}", f"--queue-url={QUEUE}"]
    # Built anew, it is started anew.
    build = hashlib.sha256(program.read_bytes()).hexdigest()[:16]
    env = {"PATH": PATH, "EVALAI_STAND_IN_BUILD": build, **aws_environment(settings.aws_endpoint)}
    ready = f"{settings.evalai_endpoint}/_stand-in/health"
    return Component(NAME, argv, lambda: answers(ready), listens, env)


def ensure(settings: Settings, program: Path) -> bool:
    """Starts the stand-in unless this very build runs; returns whether it had to."""
    part = component(settings, program)
    with cluster.exclusively(settings):
        started = cluster.ensure_started(settings, part)
        cluster.await_one(settings, part)
        if started:
            first = next_life(settings.data / "evalai-lives")
            call(settings, "POST", "/_stand-in/reset", {"first_submission": first})
    return started


def next_life(file: Path) -> int:
    """Counts a life and returns its first key."""
    try:
        lives = int(file.read_text())
    except (OSError, ValueError):
        lives = 0
    process.write_whole(file, str(lives + 1))
    return lives * KEYS_PER_LIFE + 1


def call(settings: Settings, method: str, path: str, body: Any = None, token: str | None = None) -> Any:
    """A JSON request to the stand-in; raises with its answer if it refuses."""
    data = None if body is None else json.dumps(body).encode()
    return request(settings, method, path, data, "application/json", token)


def request(
    settings: Settings, method: str, path: str, data: bytes | None, content_type: str, token: str | None
) -> Any:
    """A request with any body. The answer is JSON, or text where it is not."""
    headers = {"Content-Type": content_type} if data is not None else {}
    if token is not None:
        headers["Authorization"] = f"Bearer {token}"
    asked = urllib.request.Request(settings.evalai_endpoint + path, data=data, method=method, headers=headers)
    try:
        with DIRECT.open(asked, timeout=60) as answer:
            text = answer.read().decode()
    except urllib.error.HTTPError as error:
        reason = error.read().decode(errors="replace")[:300]
        raise LabError(f"EvalAI's stand-in answered {error.code} to {method} {path}: {reason}") from error
    except OSError as error:
        log = settings.logs / f"{NAME}.log"
        raise LabError(
            f"EvalAI's stand-in does not answer at {settings.evalai_endpoint} ({error}); see {log}"
        ) from error
    try:
        return json.loads(text)
    except ValueError:
        return text


def submit(settings: Settings, token: str, challenge: int, phase: int, image: str) -> dict[str, Any]:
    """What `evalai push` does: uploads the file that names the pushed image. Returns EvalAI's row."""
    boundary = "leaderboard-lab"
    parts = [
        ("status", None, "submitting"),
        ("method_name", None, "The demo's agent"),
        ("input_file", "submission.json", json.dumps({"submitted_image_uri": image})),
    ]
    body = "".join(form_part(boundary, *part) for part in parts) + f"--{boundary}--\r\n"
    path = f"/api/jobs/challenge/{challenge}/challenge_phase/{phase}/submission/"
    answer = request(settings, "POST", path, body.encode(), f"multipart/form-data; boundary={boundary}", token)
    if not isinstance(answer, dict) or "id" not in answer:
        raise LabError(f"EvalAI's stand-in took the submission but did not say its key: {str(answer)[:200]}")
    return answer


def form_part(boundary: str, name: str, filename: str | None, value: str) -> str:
    file = "" if filename is None else f'; filename="{filename}"\r\nContent-Type: application/json'
    return f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"{file}\r\n\r\n{value}\r\n'
