"""Owns a throwaway etcd and kube-apiserver on free loopback ports: nothing but the API, for any user, gone afterwards.

Used by `charttest`, so that checking the chart touches no cluster of anyone's.
"""

import json
import os
import secrets
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from .components import answers
from .errors import LabError
from .kube import Kube
from .process import tail
from .settings import Settings, without_proxy

TOOLS = ("etcd", "kube-apiserver", "kubectl", "helm", "kubeconform")
START_PATIENCE = 120


@contextmanager
def running(settings: Settings, tools: Path) -> Iterator[Kube]:
    """Runs the two for the time of the block; gives a Kube with all rights."""
    folder = Path(tempfile.mkdtemp(prefix="leaderboard-apiserver-"))
    children: list[subprocess.Popen[bytes]] = []
    try:
        client, peer, port = free_ports(3)
        make_key(folder)
        token = secrets.token_hex(16)
        (folder / "tokens.csv").write_text(f"{token},admin,admin,system:masters\n")
        children.append(spawn(folder, etcd(folder, tools, client, peer)))
        children.append(spawn(folder, apiserver(folder, tools, client, port)))
        await_ready(folder, children, port)
        kubeconfig = write_kubeconfig(folder, port, token)
        homes = {name: str(folder / name.lower()) for name in ("HELM_CACHE_HOME", "HELM_CONFIG_HOME", "HELM_DATA_HOME")}
        env = without_proxy(os.environ)
        env["no_proxy"] = env["NO_PROXY"] = f"127.0.0.1,{env['NO_PROXY']}"
        yield Kube(tools, {**env, **homes, "KUBECONFIG": str(kubeconfig), "KUBECACHEDIR": str(folder / "cache")})
    finally:
        for child in reversed(children):
            child.kill()
            child.wait()
        shutil.rmtree(folder, ignore_errors=True)


def free_ports(count: int) -> list[int]:
    """Ports that nobody listens on now, all different."""
    sockets = [socket.socket() for _ in range(count)]
    try:
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]
    finally:
        for one in sockets:
            one.close()


def make_key(folder: Path) -> None:
    """The key that signs the tokens of service accounts; the server does not start without one."""
    if shutil.which("openssl") is None:
        raise LabError("openssl is missing: apt-get install openssl")
    argv = ["openssl", "genrsa", "-out", str(folder / "accounts.key"), "2048"]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise LabError(f"openssl made no key: {done.stderr.strip()[-200:]}")


def etcd(folder: Path, tools: Path, client: int, peer: int) -> list[str]:
    url, peer_url = f"http://127.0.0.1:{client}", f"http://127.0.0.1:{peer}"
    return [
        str(tools / "etcd"),
        f"--data-dir={folder}/etcd",
        f"--listen-client-urls={url}",
        f"--advertise-client-urls={url}",
        f"--listen-peer-urls={peer_url}",
        f"--initial-advertise-peer-urls={peer_url}",
        f"--initial-cluster=default={peer_url}",
        "--unsafe-no-fsync",
        "--log-level=error",
    ]


def apiserver(folder: Path, tools: Path, client: int, port: int) -> list[str]:
    return [
        str(tools / "kube-apiserver"),
        "--bind-address=127.0.0.1",
        f"--secure-port={port}",
        f"--cert-dir={folder}/certificates",
        f"--etcd-servers=http://127.0.0.1:{client}",
        "--service-cluster-ip-range=10.0.0.0/24",
        "--service-account-issuer=https://kubernetes.default.svc.cluster.local",
        f"--service-account-key-file={folder}/accounts.key",
        f"--service-account-signing-key-file={folder}/accounts.key",
        f"--token-auth-file={folder}/tokens.csv",
        "--authorization-mode=RBAC",
        # Nobody makes accounts here: there is no controller manager.
        "--disable-admission-plugins=ServiceAccount",
        "--profiling=false",
    ]


def spawn(folder: Path, argv: Sequence[str]) -> "subprocess.Popen[bytes]":
    with (folder / f"{Path(argv[0]).name}.log").open("wb") as log:
        return subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=log, stderr=log)


def await_ready(folder: Path, children: Sequence["subprocess.Popen[bytes]"], port: int) -> None:
    deadline = time.monotonic() + START_PATIENCE
    while not answers(f"https://127.0.0.1:{port}/readyz"):
        ended = next((child for child in children if child.poll() is not None), None)
        if ended is not None or time.monotonic() > deadline:
            words = " | ".join(tail(log)[-200:] for log in sorted(folder.glob("*.log")))
            raise LabError(f"no API server to test the chart against ({words}); run the same command again")
        time.sleep(0.1)


def write_kubeconfig(folder: Path, port: int, token: str) -> Path:
    named = {"name": "throwaway"}
    cluster = {"server": f"https://127.0.0.1:{port}", "insecure-skip-tls-verify": True}
    config = {
        "apiVersion": "v1",
        "kind": "Config",
        "clusters": [named | {"cluster": cluster}],
        "users": [named | {"user": {"token": token}}],
        "contexts": [named | {"context": {"cluster": "throwaway", "user": "throwaway"}}],
        "current-context": "throwaway",
    }
    file = folder / "kubeconfig"
    file.write_text(json.dumps(config))
    return file
