"""Owns the certificates and kubeconfigs of the cluster: made once by openssl, kept in `<state>/pki`, whole or not at all."""

import base64
import json
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from .errors import LabError
from .process import write_whole
from .settings import API_SERVICE_ADDRESS, HOST_ADDRESS, NODE_NAME, Settings

DAYS = "3650"
API_NAMES = "DNS:kubernetes,DNS:kubernetes.default,DNS:kubernetes.default.svc,DNS:kubernetes.default.svc.cluster.local,DNS:localhost"


@dataclass(frozen=True)
class Certificate:
    """One certificate to issue: who it speaks for and, for a server, the names it answers to."""

    name: str
    subject: str
    addresses: str = ""


CERTIFICATES = (
    Certificate("admin", "/O=system:masters/CN=admin"),
    Certificate("controller-manager", "/CN=system:kube-controller-manager"),
    Certificate("scheduler", "/CN=system:kube-scheduler"),
    Certificate(
        "node", f"/O=system:nodes/CN=system:node:{NODE_NAME}", f"DNS:{NODE_NAME},IP:{HOST_ADDRESS},IP:127.0.0.1"
    ),
    Certificate("proxy", "/CN=system:kube-proxy"),
    Certificate("kubelet-client", "/O=system:masters/CN=kube-apiserver-kubelet-client"),
    Certificate("etcd", "/CN=etcd", "DNS:localhost,IP:127.0.0.1"),
    Certificate(
        "apiserver", "/CN=kube-apiserver", f"{API_NAMES},IP:127.0.0.1,IP:{HOST_ADDRESS},IP:{API_SERVICE_ADDRESS}"
    ),
)


def ensure(settings: Settings) -> None:
    """Makes all certificates if they are not there yet, and the kubeconfigs that hold them."""
    if not settings.pki.exists():
        draft = settings.pki.with_name(f".pki.{os.getpid()}")
        for stale in settings.state.glob(".pki.*"):
            shutil.rmtree(stale)
        draft.mkdir(parents=True, mode=0o700)
        make_authority(draft)
        for certificate in CERTIFICATES:
            issue(draft, certificate)
        draft.rename(settings.pki)
    for name in ("controller-manager", "scheduler", "node", "proxy"):
        write_kubeconfig(settings, name, settings.pki / f"{name}.kubeconfig")
    write_kubeconfig(settings, "admin", settings.kubeconfig)
    owner = os.environ.get("SUDO_UID", "")
    if owner.isdecimal():
        os.chown(settings.kubeconfig, int(owner), -1)


def make_authority(folder: Path) -> None:
    """The certificate authority, and the key that signs the tokens of service accounts (RSA, as kubeadm makes it)."""
    openssl("ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", str(folder / "ca.key"))
    openssl(
        *("req", "-x509", "-new", "-sha256", "-days", DAYS, "-key", str(folder / "ca.key")),
        *("-subj", "/CN=leaderboard-lab", "-out", str(folder / "ca.crt")),
        *("-addext", "keyUsage=critical,digitalSignature,keyCertSign,cRLSign"),
    )
    openssl("genrsa", "-out", str(folder / "service-accounts.key"), "2048")
    openssl("rsa", "-in", str(folder / "service-accounts.key"), "-pubout", "-out", str(folder / "service-accounts.pub"))


def issue(folder: Path, certificate: Certificate) -> None:
    """A key and a certificate signed by our authority, usable as a client and, where it has addresses, as a server."""
    key, request = folder / f"{certificate.name}.key", folder / f"{certificate.name}.csr"
    extensions = folder / f"{certificate.name}.ext"
    lines = ["basicConstraints=CA:FALSE", "keyUsage=digitalSignature", "extendedKeyUsage=clientAuth,serverAuth"]
    if certificate.addresses:
        lines.append(f"subjectAltName={certificate.addresses}")
    extensions.write_text("\n".join(lines) + "\n")
    openssl("ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", str(key))
    openssl("req", "-new", "-sha256", "-key", str(key), "-subj", certificate.subject, "-out", str(request))
    openssl(
        *("x509", "-req", "-sha256", "-days", DAYS, "-in", str(request), "-extfile", str(extensions)),
        *("-CA", str(folder / "ca.crt"), "-CAkey", str(folder / "ca.key"), "-CAcreateserial"),
        *("-out", str(folder / f"{certificate.name}.crt")),
    )
    request.unlink()
    extensions.unlink()


def openssl(*arguments: str) -> None:
    done = subprocess.run(["openssl", *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise LabError(
            f"openssl {arguments[0]} failed ({done.stderr.strip()[-200:]}): check the installation of openssl"
        )


def kubeconfig(settings: Settings, name: str) -> str:
    """A kubeconfig (JSON, which is YAML too) for the certificate called `name`."""

    def data(file: str) -> str:
        return base64.b64encode((settings.pki / file).read_bytes()).decode()

    content = {
        "apiVersion": "v1",
        "kind": "Config",
        "clusters": [
            {
                "name": "leaderboard-local",
                "cluster": {"server": settings.api_endpoint, "certificate-authority-data": data("ca.crt")},
            }
        ],
        "users": [
            {
                "name": name,
                "user": {"client-certificate-data": data(f"{name}.crt"), "client-key-data": data(f"{name}.key")},
            }
        ],
        "contexts": [{"name": "leaderboard-local", "context": {"cluster": "leaderboard-local", "user": name}}],
        "current-context": "leaderboard-local",
    }
    return json.dumps(content, indent=2) + "\n"


def write_kubeconfig(settings: Settings, name: str, file: Path) -> None:
    """Writes a kubeconfig if it differs from what is there, so that a person's current context survives an idle `up`."""
    text = kubeconfig(settings, name)
    try:
        old, new = json.loads(file.read_text()), json.loads(text)
        if all(old[key] == new[key] for key in ("users", "clusters")):
            return
    except (OSError, ValueError, KeyError):
        pass
    write_whole(file, text)


def choose_namespace(file: Path, namespace: str) -> None:
    """Makes it the one that kubectl takes unasked; the file keeps its owner. `kubectl config` writes YAML, and tests read JSON."""
    content = json.loads(file.read_text())
    content["contexts"][0]["context"]["namespace"] = namespace
    file.write_text(json.dumps(content, indent=2) + "\n")


def authority_data(settings: Settings) -> str:
    """The authority's certificate as kubeconfigs hold it (base64)."""
    return base64.b64encode((settings.pki / "ca.crt").read_bytes()).decode()
