"""Owns where everything is: folders, ports and addresses, with their overrides from the environment. Starts nothing."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from .errors import LabError

NODE_NAME = "leaderboard-local"
NODE_LABEL = "leaderboard.carla.org/local=true"
BRIDGE = "lbo0"
BRIDGE_MAC = "02:4c:42:4f:00:01"
HOST_ADDRESS = "10.77.0.1"
POD_NETWORK = "10.77.0.0/24"
SERVICE_NETWORK = "10.78.0.0/24"
API_SERVICE_ADDRESS = "10.78.0.1"
CNI_NETWORK = "leaderboard-local"
CGROUP = "leaderboard-lab"
REGION = "us-east-1"
# A Unix socket's path may have 107 bytes.
LONGEST_SOCKET_PATH = 107

PORTS = {
    "apiserver": 16443,
    "etcd": 12379,
    "etcd_peer": 12380,
    "scheduler": 16259,
    "controller_manager": 16257,
    "kubelet": 16250,
    "kubelet_health": 16248,
    "proxy_health": 16256,
    "proxy_metrics": 16249,
    "aws": 4566,
    "evalai": 8000,
}


@dataclass(frozen=True)
class Settings:
    """Folders and ports of one lab. All state is below `state`, all downloads and builds below `cache`."""

    repository: Path
    state: Path
    cache: Path
    ports: Mapping[str, int]
    internet: bool
    # A newer containerd than Debian's, built from source: it knows CDI devices.
    builds_containerd: bool

    @property
    def local(self) -> Path:
        return self.repository / "local"

    @property
    def logs(self) -> Path:
        return self.state / "logs"

    @property
    def pki(self) -> Path:
        return self.state / "pki"

    @property
    def run(self) -> Path:
        return self.state / "run"

    @property
    def config(self) -> Path:
        return self.state / "config"

    @property
    def data(self) -> Path:
        return self.state / "data"

    @property
    def kubeconfig(self) -> Path:
        return self.state / "kubeconfig"

    @property
    def containerd_socket(self) -> Path:
        return self.run / "containerd.sock"

    @property
    def pod_logs(self) -> Path:
        return self.data / "pod-logs"

    @property
    def audit_log(self) -> Path:
        return self.logs / "audit.log"

    @property
    def aws_calls(self) -> Path:
        """What the operator's programs asked of the AWS stand-in."""
        return self.logs / "aws-calls.jsonl"

    @property
    def registry(self) -> str:
        return f"{HOST_ADDRESS}:{self.ports['aws']}"

    @property
    def aws_endpoint(self) -> str:
        return f"http://{HOST_ADDRESS}:{self.ports['aws']}"

    @property
    def evalai_endpoint(self) -> str:
        return f"http://{HOST_ADDRESS}:{self.ports['evalai']}"

    @property
    def api_endpoint(self) -> str:
        return f"https://{HOST_ADDRESS}:{self.ports['apiserver']}"


def load(repository: Path, env: Mapping[str, str] | None = None) -> Settings:
    """The settings for the repository in `repository`, as the environment overrides them."""
    values = os.environ if env is None else env
    home = Path(values.get("HOME") or Path.home())
    caches = Path(values.get("XDG_CACHE_HOME") or home / ".cache")
    return Settings(
        repository=repository,
        state=Path(values.get("LEADERBOARD_LAB_STATE") or repository / ".local").absolute(),
        cache=Path(values.get("LEADERBOARD_TOOLS") or caches / "leaderboard-operator" / "tools").absolute(),
        ports={name: port(values, name, default) for name, default in PORTS.items()},
        internet=values.get("LEADERBOARD_LAB_INTERNET", "") == "1",
        builds_containerd=values.get("LEADERBOARD_LAB_CONTAINERD", "") == "built",
    )


def port(values: Mapping[str, str], name: str, default: int) -> int:
    """The port of one part: `LEADERBOARD_LAB_PORT_<NAME>`, else its default."""
    variable = f"LEADERBOARD_LAB_PORT_{name.upper()}"
    text = values.get(variable, "")
    if not text:
        return default
    if not text.isdecimal() or not 1 <= int(text) <= 65535:
        raise LabError(f"{variable}={text} is no port: give a number from 1 to 65535")
    return int(text)


def client_environment(settings: Settings) -> dict[str, str]:
    """What a client of the cluster and of the AWS stand-in needs in its environment (no PATH)."""
    return {
        "KUBECONFIG": str(settings.kubeconfig),
        **aws_environment(settings.aws_endpoint),
        "LAB_HOST": HOST_ADDRESS,
        "LAB_REGISTRY": settings.registry,
        "LAB_EVALAI": settings.evalai_endpoint,
        "LAB_AUDIT_LOG": str(settings.audit_log),
        "LAB_LOGS": str(settings.logs),
    }


def aws_environment(endpoint: str) -> dict[str, str]:
    """What every AWS client needs to reach the stand-in at `endpoint`; the keys are dummies."""
    return {
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_REGION": REGION,
        "AWS_DEFAULT_REGION": REGION,
        "AWS_EC2_METADATA_DISABLED": "true",
        "AWS_ENDPOINT_URL": endpoint,
    }


def without_proxy(env: Mapping[str, str]) -> dict[str, str]:
    """The environment for a client of the lab: a proxy of this machine must not be asked for the lab's addresses."""
    result = dict(env)
    for name in ("NO_PROXY", "no_proxy"):
        result[name] = ",".join(part for part in (HOST_ADDRESS, API_SERVICE_ADDRESS, env.get(name, "")) if part)
    return result
