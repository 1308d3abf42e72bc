"""Owns which tools there are, in which Go module each is pinned, and the key of its place in the cache. Pure: builds nothing."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from .errors import LabError

KUBERNETES_VERSION = "v1.35.4"


@dataclass(frozen=True)
class Tool:
    """One program of a tool set: its Go package and how long a cold build takes on two cores, in seconds."""

    package: str
    seconds: int


@dataclass(frozen=True)
class ToolSet:
    """Tools that share one go.mod (`local/tools/<name>`) and one set of link flags."""

    name: str
    ldflags: str
    tools: Mapping[str, Tool]
    # Build tags, between commas.
    tags: str = ""


def kubernetes_ldflags(version: str) -> str:
    """Without these the server reports `v0.0.0-master`, which kubectl refuses to parse."""
    major, minor, _ = version.removeprefix("v").split(".")
    flags = ["-s", "-w"]
    for package in ("k8s.io/component-base/version", "k8s.io/client-go/pkg/version"):
        flags += [
            f"-X {package}.gitVersion={version}",
            f"-X {package}.gitMajor={major}",
            f"-X {package}.gitMinor={minor}",
        ]
    return " ".join(flags)


def kubernetes(program: str, seconds: int) -> Tool:
    return Tool(f"k8s.io/kubernetes/cmd/{program}", seconds)


def containerd(program: str, seconds: int) -> Tool:
    return Tool(f"github.com/containerd/containerd/v2/cmd/{program}", seconds)


SETS: dict[str, ToolSet] = {
    tool_set.name: tool_set
    for tool_set in (
        # etcd and helm share the greater part of their packages with Kubernetes, which are then compiled once.
        ToolSet(
            "kubernetes",
            kubernetes_ldflags(KUBERNETES_VERSION),
            {
                "etcd": Tool("go.etcd.io/etcd/server/v3", 45),
                "kube-apiserver": kubernetes("kube-apiserver", 180),
                "kubectl": kubernetes("kubectl", 12),
                "kube-scheduler": kubernetes("kube-scheduler", 14),
                "kube-controller-manager": kubernetes("kube-controller-manager", 30),
                "kubelet": kubernetes("kubelet", 12),
                "kube-proxy": kubernetes("kube-proxy", 5),
                "helm": Tool("helm.sh/helm/v4/cmd/helm", 20),
            },
        ),
        ToolSet(
            "misc",
            "-s -w",
            {
                "crane": Tool("github.com/google/go-containerregistry/cmd/crane", 4),
                "kubeconform": Tool("github.com/yannh/kubeconform/cmd/kubeconform", 2),
                "kwok": Tool("sigs.k8s.io/kwok/cmd/kwok", 65),
            },
        ),
        ToolSet("pause", "-s -w", {"pause": Tool(".", 1)}),
        # Without what finds the targets of each cloud, which no test needs, and without the web pages.
        ToolSet(
            "prometheus",
            "-s -w",
            {
                "promtool": Tool("github.com/prometheus/prometheus/cmd/promtool", 70),
                "prometheus": Tool("github.com/prometheus/prometheus/cmd/prometheus", 38),
            },
            tags="remove_all_sd",
        ),
        ToolSet("otelcol", "-s -w", {"otelcol": Tool(".", 56)}),
        ToolSet("gpu", "-s -w", {"fake-gpu": Tool(".", 3)}),
        ToolSet(
            "containerd",
            "-s -w",
            {
                "containerd": containerd("containerd", 110),
                "containerd-shim-runc-v2": containerd("containerd-shim-runc-v2", 5),
            },
        ),
    )
}

# What controller-runtime's users know as envtest: a folder that holds these wins over ours.
ENVTEST_TOOLS = ("etcd", "kube-apiserver", "kubectl")


def set_of(name: str) -> ToolSet:
    """The set that holds the tool `name`."""
    for tool_set in SETS.values():
        if name in tool_set.tools:
            return tool_set
    known = " ".join(sorted(tool for tool_set in SETS.values() for tool in tool_set.tools))
    raise LabError(f"no tool is called {name}: choose from {known}")


def in_build_order(names: Iterable[str]) -> list[tuple[ToolSet, str]]:
    """The named tools without repeats, in the order in which the second shares most with the first."""
    wanted = {name: set_of(name) for name in names}
    return [(tool_set, name) for tool_set in SETS.values() for name in tool_set.tools if name in wanted]


def build_flags(tool_set: ToolSet) -> list[str]:
    """The arguments of `go build` besides output and package."""
    tags = ["-tags", tool_set.tags] if tool_set.tags else []
    # The linker leaves out what debuggers read (-s -w): the compiler need not make it.
    debug = "-gcflags=all=-dwarf=false"
    return ["-trimpath", "-buildvcs=false", "-mod=readonly", debug, *tags, "-ldflags", tool_set.ldflags]


def cache_key(module: Path, flags: Iterable[str], platform: str) -> str:
    """16 hex digits over everything that decides what a build gives: module files, sources of our own, flags, platform."""
    digest = hashlib.sha256()
    for file in sorted([*module.glob("go.mod"), *module.glob("go.sum"), *module.glob("*.go")]):
        content = file.read_bytes()
        digest.update(f"{file.name}\0{len(content)}\0".encode() + content)
    digest.update("\0".join([*flags, platform]).encode())
    return digest.hexdigest()[:16]
