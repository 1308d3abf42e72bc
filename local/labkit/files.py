"""Owns the configuration files of the cluster's parts: pure functions from the settings to their text."""

import json

from .settings import BRIDGE, CGROUP, CNI_NETWORK, HOST_ADDRESS, NODE_NAME, POD_NETWORK, Settings

PAUSE_IMAGE = "leaderboard-local/pause:1"
# containerd knows images by their full names only.
PAUSE_REFERENCE = f"docker.io/{PAUSE_IMAGE}"


def audit_policy() -> str:
    """Every write at Metadata level once it is answered, so that writes can be counted; of reads those of the admin alone, as whom the
    operator's programs run in tests, so that each right that they use is known (`rights`)."""
    reads = ["get", "list", "watch"]
    return as_yaml(
        {
            "apiVersion": "audit.k8s.io/v1",
            "kind": "Policy",
            "omitStages": ["RequestReceived"],
            "rules": [
                {"level": "Metadata", "verbs": reads, "users": ["admin"], "omitStages": ["ResponseStarted"]},
                {"level": "None", "verbs": reads},
                {"level": "Metadata"},
            ],
        }
    )


def containerd(settings: Settings, cni_bin: str) -> str:
    """containerd's own root, state and socket, nothing shared with an engine that a machine may already have."""
    return f"""version = 2
root = "{settings.data}/containerd"
state = "{settings.run}/containerd"
# Only the CRI is needed: the rest asks for modules and folders that a bare machine lacks.
disabled_plugins = [
  "io.containerd.internal.v1.opt",
  "io.containerd.snapshotter.v1.btrfs",
  "io.containerd.snapshotter.v1.zfs",
  "io.containerd.snapshotter.v1.devmapper",
  "io.containerd.snapshotter.v1.aufs",
]

[grpc]
  address = "{settings.containerd_socket}"

[plugins."io.containerd.grpc.v1.cri"]
  # A machine may withhold CAP_SYS_RESOURCE, without which scores can't be lowered.
  restrict_oom_score_adj = true
  sandbox_image = "{PAUSE_REFERENCE}"
  netns_mounts_under_state_dir = true
  disable_tcp_service = true
  [plugins."io.containerd.grpc.v1.cri".cni]
    bin_dir = "{cni_bin}"
    conf_dir = "{settings.config}/cni"
  [plugins."io.containerd.grpc.v1.cri".containerd.runtimes.runc]
    runtime_type = "io.containerd.runc.v2"
    [plugins."io.containerd.grpc.v1.cri".containerd.runtimes.runc.options]
      SystemdCgroup = false
  [plugins."io.containerd.grpc.v1.cri".registry]
    config_path = "{settings.config}/registries"
"""


def registry_host(settings: Settings) -> str:
    """Configures containerd: the stand-in's registry speaks plain HTTP."""
    return f'server = "{settings.aws_endpoint}"\n\n[host."{settings.aws_endpoint}"]\n  capabilities = ["pull", "resolve"]\n'


def cni(settings: Settings) -> str:
    """The Pods' network: all on one bridge. Without `internet`, nothing leaves the machine, as nothing is masqueraded."""
    return as_yaml(
        {
            "cniVersion": "1.0.0",
            "name": CNI_NETWORK,
            "plugins": [
                {
                    "type": "bridge",
                    "bridge": BRIDGE,
                    "isGateway": True,
                    "ipMasq": settings.internet,
                    "hairpinMode": True,
                    "ipam": {
                        "type": "host-local",
                        "dataDir": f"{settings.data}/cni",
                        "ranges": [[{"subnet": POD_NETWORK, "gateway": HOST_ADDRESS, "rangeStart": "10.77.0.10"}]],
                        "routes": [{"dst": "0.0.0.0/0"}],
                    },
                },
                {"type": "portmap", "capabilities": {"portMappings": True}},
            ],
        }
    )


def kubelet(settings: Settings) -> str:
    return as_yaml(
        {
            "apiVersion": "kubelet.config.k8s.io/v1beta1",
            "kind": "KubeletConfiguration",
            "address": HOST_ADDRESS,
            "port": settings.ports["kubelet"],
            "readOnlyPort": 0,
            "healthzBindAddress": "127.0.0.1",
            "healthzPort": settings.ports["kubelet_health"],
            "containerRuntimeEndpoint": f"unix://{settings.containerd_socket}",
            "authentication": {
                "anonymous": {"enabled": False},
                "webhook": {"enabled": True},
                "x509": {"clientCAFile": f"{settings.pki}/ca.crt"},
            },
            "authorization": {"mode": "Webhook"},
            "tlsCertFile": f"{settings.pki}/node.crt",
            "tlsPrivateKeyFile": f"{settings.pki}/node.key",
            "podLogsDir": str(settings.pod_logs),
            "volumePluginDir": f"{settings.data}/kubelet/volume-plugins",
            "cgroupDriver": "cgroupfs",
            "cgroupRoot": f"/{CGROUP}",
            "failCgroupV1": False,
            "failSwapOn": False,
            "localStorageCapacityIsolation": True,
            "makeIPTablesUtilChains": False,
            "resolvConf": f"{settings.config}/resolv.conf",
            "maxPods": 110,
            "podPidsLimit": 4096,
            # One hanging pull must not stop the pulls of every other Pod.
            "serializeImagePulls": False,
            # Restarts are what the tests are about: not minutes of back-off.
            "crashLoopBackOff": {"maxContainerRestartPeriod": "3s"},
            "evictionHard": {"memory.available": "100Mi", "nodefs.available": "1%", "imagefs.available": "1%"},
            "imageGCHighThresholdPercent": 100,
            "imageGCLowThresholdPercent": 99,
            "syncFrequency": "10s",
            "nodeStatusUpdateFrequency": "5s",
            "shutdownGracePeriod": "0s",
        }
    )


def kube_proxy(settings: Settings) -> str:
    return as_yaml(
        {
            "apiVersion": "kubeproxy.config.k8s.io/v1alpha1",
            "kind": "KubeProxyConfiguration",
            "mode": "nftables",
            "hostnameOverride": NODE_NAME,
            "clusterCIDR": POD_NETWORK,
            "clientConnection": {"kubeconfig": f"{settings.pki}/proxy.kubeconfig"},
            "healthzBindAddress": f"127.0.0.1:{settings.ports['proxy_health']}",
            "metricsBindAddress": f"127.0.0.1:{settings.ports['proxy_metrics']}",
            # Leave the machine's connection tracking as it is.
            "conntrack": {"maxPerCore": 0, "tcpEstablishedTimeout": "0s", "tcpCloseWaitTimeout": "0s"},
        }
    )


def as_yaml(content: object) -> str:
    """JSON, which every YAML reader takes."""
    return json.dumps(content, indent=2) + "\n"


def all_files(settings: Settings, cni_bin: str) -> dict[str, dict[str, str]]:
    """The configuration files of each part: part name -> path below `<state>/config` -> text."""
    return {
        "kube-apiserver": {"audit.yaml": audit_policy()},
        "containerd": {
            "containerd.toml": containerd(settings, cni_bin),
            f"registries/{settings.registry}/hosts.toml": registry_host(settings),
            "cni/10-leaderboard.conflist": cni(settings),
        },
        # An empty one: there is no name server inside the cluster, and Pods need not know the machine's.
        "kubelet": {"kubelet.yaml": kubelet(settings), "resolv.conf": "" if not settings.internet else host_resolver()},
        "kube-proxy": {"proxy.yaml": kube_proxy(settings)},
    }


def host_resolver() -> str:
    """The machine's own resolver file, for Pods that may reach the internet."""
    try:
        with open("/etc/resolv.conf", encoding="utf-8") as handle:
            return handle.read()
    except OSError:
        return ""
