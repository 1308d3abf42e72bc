"""Owns the list of the lab's background processes: command line, environment, configuration and the probe that reports "ready".

Pure but for reading file contents into a digest; `cluster` starts them.
"""

import hashlib
import http.client
import socket
import ssl
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from urllib.parse import urlsplit

from . import files, network
from .settings import HOST_ADDRESS, NODE_LABEL, NODE_NAME, SERVICE_NETWORK, Settings, aws_environment

# The stand-in runs code for anyone who asks (Lambda and others), and Pods reach it: only what the operator needs is served.
AWS_SERVICES = "sqs,s3,dynamodb,secretsmanager,logs,ecr,sts,iam"
PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


@dataclass(frozen=True)
class Component:
    """One background process."""

    name: str
    argv: list[str]
    ready: Callable[[], bool]
    # (address, port) pairs it listens on
    listens: list[tuple[str, int]] = field(default_factory=list)
    env: dict[str, str] = field(default_factory=dict)
    # path -> text, written before the start
    files: dict[Path, str] = field(default_factory=dict)
    # seconds between the request to end and the kill
    patience: float = 10
    # done right before the start
    prepare: Callable[[], None] | None = None

    def digest(self) -> str:
        """Over everything the process was started with: another digest means that it must be started again."""
        text = repr((self.argv, sorted(self.env.items()), sorted((str(p), t) for p, t in self.files.items())))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def answers(url: str, settings: Settings | None = None) -> bool:
    """Whether an HTTP(S) GET is answered with 200; HTTPS with the administrator's certificate if `settings` are given."""
    parts = urlsplit(url)
    host, port = parts.hostname or "", parts.port or 0
    if parts.scheme == "https":
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        if settings is not None:
            context.load_cert_chain(settings.pki / "admin.crt", settings.pki / "admin.key")
        connection: http.client.HTTPConnection = http.client.HTTPSConnection(host, port, timeout=3, context=context)
    else:
        connection = http.client.HTTPConnection(host, port, timeout=3)
    try:
        connection.request("GET", parts.path)
        return connection.getresponse().status == 200
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()


def accepts(path: Path) -> bool:
    """Whether something listens on a Unix socket."""
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return False
        return True


def etcd(settings: Settings, tools: Path) -> Component:
    client, peer, pki = settings.ports["etcd"], settings.ports["etcd_peer"], settings.pki
    url, peer_url = f"https://127.0.0.1:{client}", f"http://127.0.0.1:{peer}"
    argv = [
        str(tools / "etcd"),
        f"--name={NODE_NAME}",
        f"--data-dir={settings.data}/etcd",
        f"--listen-client-urls={url}",
        f"--advertise-client-urls={url}",
        f"--listen-peer-urls={peer_url}",
        f"--initial-advertise-peer-urls={peer_url}",
        f"--initial-cluster={NODE_NAME}={peer_url}",
        f"--cert-file={pki}/etcd.crt",
        f"--key-file={pki}/etcd.key",
        f"--trusted-ca-file={pki}/ca.crt",
        "--client-cert-auth",
        # The data lives as long as the lab: it need not outlive a power cut.
        "--unsafe-no-fsync",
        "--log-level=warn",
    ]
    listens = [("127.0.0.1", client), ("127.0.0.1", peer)]
    return Component("etcd", argv, lambda: answers(f"{url}/health", settings), listens)


def apiserver(settings: Settings, tools: Path) -> Component:
    pki, port = settings.pki, settings.ports["apiserver"]
    argv = [
        str(tools / "kube-apiserver"),
        f"--bind-address={HOST_ADDRESS}",
        f"--advertise-address={HOST_ADDRESS}",
        f"--secure-port={port}",
        f"--service-cluster-ip-range={SERVICE_NETWORK}",
        f"--etcd-servers=https://127.0.0.1:{settings.ports['etcd']}",
        f"--etcd-cafile={pki}/ca.crt",
        f"--etcd-certfile={pki}/admin.crt",
        f"--etcd-keyfile={pki}/admin.key",
        f"--client-ca-file={pki}/ca.crt",
        f"--tls-cert-file={pki}/apiserver.crt",
        f"--tls-private-key-file={pki}/apiserver.key",
        f"--kubelet-certificate-authority={pki}/ca.crt",
        f"--kubelet-client-certificate={pki}/kubelet-client.crt",
        f"--kubelet-client-key={pki}/kubelet-client.key",
        "--kubelet-preferred-address-types=InternalIP",
        "--service-account-issuer=https://kubernetes.default.svc.cluster.local",
        f"--service-account-key-file={pki}/service-accounts.pub",
        f"--service-account-signing-key-file={pki}/service-accounts.key",
        "--authorization-mode=Node,RBAC",
        "--enable-admission-plugins=NodeRestriction",
        "--allow-privileged=true",
        "--anonymous-auth=false",
        "--profiling=false",
        f"--audit-policy-file={settings.config}/audit.yaml",
        f"--audit-log-path={settings.audit_log}",
        "--audit-log-maxsize=256",
        "--audit-log-maxbackup=2",
        "--shutdown-send-retry-after=false",
    ]
    # It waits up to a minute for its watches to end: nobody here needs that.
    return Component(
        "kube-apiserver",
        argv,
        lambda: answers(f"{settings.api_endpoint}/readyz", settings),
        [(HOST_ADDRESS, port)],
        patience=5,
    )


def controller_manager(settings: Settings, tools: Path) -> Component:
    pki, port = settings.pki, settings.ports["controller_manager"]
    kubeconfig = f"{pki}/controller-manager.kubeconfig"
    argv = [
        str(tools / "kube-controller-manager"),
        f"--kubeconfig={kubeconfig}",
        f"--authentication-kubeconfig={kubeconfig}",
        f"--authorization-kubeconfig={kubeconfig}",
        "--bind-address=127.0.0.1",
        f"--secure-port={port}",
        "--leader-elect=false",
        "--use-service-account-credentials=true",
        f"--service-account-private-key-file={pki}/service-accounts.key",
        f"--root-ca-file={pki}/ca.crt",
        f"--cluster-signing-cert-file={pki}/ca.crt",
        f"--cluster-signing-key-file={pki}/ca.key",
        "--profiling=false",
    ]
    return Component(
        "kube-controller-manager", argv, lambda: answers(f"https://127.0.0.1:{port}/healthz"), [("127.0.0.1", port)]
    )


def scheduler(settings: Settings, tools: Path) -> Component:
    port, kubeconfig = settings.ports["scheduler"], f"{settings.pki}/scheduler.kubeconfig"
    argv = [
        str(tools / "kube-scheduler"),
        f"--kubeconfig={kubeconfig}",
        f"--authentication-kubeconfig={kubeconfig}",
        f"--authorization-kubeconfig={kubeconfig}",
        "--bind-address=127.0.0.1",
        f"--secure-port={port}",
        "--leader-elect=false",
        "--profiling=false",
    ]
    return Component(
        "kube-scheduler", argv, lambda: answers(f"https://127.0.0.1:{port}/healthz"), [("127.0.0.1", port)]
    )


def containerd(settings: Settings, program: str) -> Component:
    argv = [program, f"--config={settings.config}/containerd.toml"]
    # Its shim is looked up there: the one of the same version comes first.
    env = {"PATH": f"{Path(program).parent}:{PATH}"}
    return Component("containerd", argv, lambda: accepts(settings.containerd_socket), env=env)


def kubelet(settings: Settings, tools: Path) -> Component:
    health = settings.ports["kubelet_health"]
    argv = [
        str(tools / "kubelet"),
        f"--config={settings.config}/kubelet.yaml",
        f"--kubeconfig={settings.pki}/node.kubeconfig",
        f"--root-dir={settings.data}/kubelet",
        f"--hostname-override={NODE_NAME}",
        f"--node-ip={HOST_ADDRESS}",
        f"--node-labels={NODE_LABEL}",
    ]
    listens = [(HOST_ADDRESS, settings.ports["kubelet"]), ("127.0.0.1", health)]
    return Component("kubelet", argv, lambda: answers(f"http://127.0.0.1:{health}/healthz"), listens)


def kube_proxy(settings: Settings, tools: Path) -> Component:
    health, metrics = settings.ports["proxy_health"], settings.ports["proxy_metrics"]
    argv = [str(tools / "kube-proxy"), f"--config={settings.config}/proxy.yaml"]
    listens = [("127.0.0.1", health), ("127.0.0.1", metrics)]
    # Over the tables of an earlier run it leaves the chains of known endpoints empty (1.35.4 with nft 1.0.6).
    prepare = network.remove_proxy_tables
    return Component(
        "kube-proxy", argv, lambda: answers(f"http://127.0.0.1:{health}/healthz"), listens, prepare=prepare
    )


def aws(settings: Settings, python: Path) -> Component:
    (program, *_), env = aws_command(settings, python, HOST_ADDRESS, settings.ports["aws"])
    argv = [program, "-m", "labkit.aws_recorder", str(settings.aws_calls)]
    env |= {"PYTHONPATH": str(settings.local), "PYTHONDONTWRITEBYTECODE": "1"}
    listens = [(HOST_ADDRESS, settings.ports["aws"])]
    return Component("aws", argv, lambda: answers(f"{settings.aws_endpoint}/_ministack/health"), listens, env)


def aws_command(settings: Settings, python: Path, address: str, port: int) -> tuple[list[str], dict[str, str]]:
    """The command line and the environment of the AWS stand-in listening at `address`:`port`."""
    env = {
        "PATH": PATH,
        **aws_environment(f"http://{address}:{port}"),
        "BIND_HOST": address,
        "GATEWAY_PORT": str(port),
        # The host of the queue URLs that it hands out.
        "MINISTACK_HOST": address,
        "SERVICES": AWS_SERVICES,
        "STATE_DIR": f"{settings.data}/aws",
        "S3_DATA_DIR": f"{settings.data}/aws/s3",
        "LOG_LEVEL": "WARNING",
    }
    return [str(python), "-m", "ministack"], env


def all_components(
    settings: Settings, tools: Path, python: Path, containerd_program: str, cni_bin: str
) -> list[Component]:
    """Every process of the lab in the order of starting, with its configuration files."""
    texts = files.all_files(settings, cni_bin)
    made = [
        etcd(settings, tools),
        containerd(settings, containerd_program),
        aws(settings, python),
        apiserver(settings, tools),
        controller_manager(settings, tools),
        scheduler(settings, tools),
        kubelet(settings, tools),
        kube_proxy(settings, tools),
    ]
    return [with_files(settings, component, texts.get(component.name, {})) for component in made]


def with_files(settings: Settings, component: Component, texts: dict[str, str]) -> Component:
    """The component with its configuration files and the environment every one of them gets."""
    env = {"PATH": PATH, "HOME": str(settings.data)} | component.env
    paths = {settings.config / name: text for name, text in texts.items()}
    return replace(component, env=env, files=paths)
