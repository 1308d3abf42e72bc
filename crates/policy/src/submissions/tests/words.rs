//! The cause of a failed start: a row for each of the words that kubelets, container engines, GPU toolkits, shims, runc and registries
//! use.

use crate::submissions::cause::Cause::{
    self, Host, ImageKind, ImageMissing, ImagePlatform, ImageProgram, ImageUser, Node, Registry,
};
use crate::submissions::cause::{of_config, of_pull, of_start};

const TASK: &str =
    "failed to create containerd task: failed to create shim task: OCI runtime create failed: runc create failed: ";
const PULL: &str = "rpc error: code = Unknown desc = failed to pull and unpack image \"r.example/team/agent:1\": ";

/// The source, its words, and the cause that they show.
type Row = (&'static str, &'static str, Cause);

fn check(judge: impl Fn(&str) -> Cause, prefix: &str, rows: &[Row]) {
    for (source, words, expected) in rows {
        let words = format!("{prefix}{words}");
        assert_eq!(judge(&words), *expected, "{source}: {words}");
    }
}

#[test]
fn a_setting_is_the_hosts_unless_the_kubelet_refuses_the_images_user() {
    check(
        of_config,
        "",
        &[
            (
                "kubelet",
                "container has runAsNonRoot and image will run as root (pod: \"sub-1-x_demo(1b2)\", container: agent-1)",
                ImageUser,
            ),
            (
                "kubelet",
                "container has runAsNonRoot and image has non-numeric user (carla), cannot verify user is non-root (pod: \"sub-1-x\", \
                 container: agent-1)",
                ImageUser,
            ),
            (
                "kubelet",
                "container's runAsUser breaks non-root policy (pod: \"sub-1-x\", container: agent-1)",
                Host,
            ),
            ("kubelet", "secret \"nosecret\" not found", Host),
            ("kubelet", "couldn't find key zz in Secret ns/have", Host),
            (
                "kubelet",
                "failed to sync configmap cache: timed out waiting for the condition",
                Host,
            ),
        ],
    );
}

#[test]
fn what_runc_misses_in_the_image_is_the_images() {
    check(
        of_start,
        TASK,
        &[
            (
                "runc",
                "unable to start container process: exec: \"/nope\": stat /nope: no such file or directory: unknown",
                ImageProgram,
            ),
            (
                "runc 1.2",
                "unable to start container process: error during container init: exec: \"/nope\": stat /nope: no such file or directory: \
                 unknown",
                ImageProgram,
            ),
            (
                "runc",
                "unable to start container process: exec: \"python4\": executable file not found in $PATH: unknown",
                ImageProgram,
            ),
            (
                "runc",
                "unable to start container process: exec: \"/bin/noexec\": permission denied: unknown",
                ImageProgram,
            ),
            (
                "runc",
                "unable to start container process: chdir to cwd (\"/home/nonroot\") set in config.json failed: permission denied: unknown",
                ImageProgram,
            ),
            (
                "runc",
                "unable to start container process: unable to find user carla: no matching entries in passwd file: unknown",
                ImageProgram,
            ),
        ],
    );
    check(
        of_start,
        "",
        &[
            (
                "runc 1.0",
                "OCI runtime create failed: container_linux.go:380: starting container process caused: exec: \"/nope\": stat /nope: no such \
                 file or directory: unknown",
                ImageProgram,
            ),
            (
                "runc",
                "standard_init_linux.go:228: exec user process caused: exec format error",
                ImageProgram,
            ),
            (
                "crun",
                "container create failed: executable file `/nope` not found in $PATH: No such file or directory",
                ImageProgram,
            ),
            (
                "crun",
                "container create failed: exec container process `/bin/agent`: Exec format error",
                ImageProgram,
            ),
            (
                "containerd",
                "failed to create containerd container: mount callback failed on \
                 /var/lib/containerd/tmpmounts/containerd-mount2894: no users found",
                ImageProgram,
            ),
            (
                "containerd",
                "failed to create containerd container: mount callback failed on /var/lib/containerd/tmpmounts/containerd-mount2894: open \
                 /var/lib/containerd/tmpmounts/containerd-mount2894/etc/passwd: no such file or directory",
                ImageProgram,
            ),
        ],
    );
}

#[test]
fn what_the_gpu_toolkit_fails_at_is_the_nodes_though_it_misses_files() {
    check(
        of_start,
        TASK,
        &[
            (
                "container toolkit",
                "unable to start container process: error during container init: error running prestart hook #0: exit status 1, stdout: , \
                 stderr: Auto-detected mode as 'legacy' nvidia-container-cli: initialization error: nvml error: driver not loaded: unknown",
                Node,
            ),
            (
                "container toolkit",
                "unable to start container process: error during container init: error running hook #0: error running hook: exit status 1, \
                 stdout: , stderr: nvidia-container-cli: ldcache error: open failed: /sbin/ldconfig.real: no such file or directory: unknown",
                Node,
            ),
            (
                "container toolkit",
                "unable to start container process: exec: \"nvidia-container-runtime-hook\": executable file not found in $PATH: unknown",
                Node,
            ),
            (
                "CDI",
                "could not apply required modification to OCI specification: error modifying OCI spec: failed to inject CDI devices: \
                 unresolvable CDI devices nvidia.com/gpu=0: unknown",
                Node,
            ),
        ],
    );
    check(
        of_start,
        "",
        &[
            (
                "CDI",
                "failed to generate container \"4f\" spec: failed to generate spec: failed to inject CDI devices: unresolvable CDI devices \
                 k8s.gpu.nvidia.com/claim=gpu-1",
                Node,
            ),
            (
                "CDI",
                "failed to generate spec: failed to inject CDI devices: failed to stat CDI host device \"/dev/nvidia0\": no such file or \
                 directory",
                Node,
            ),
        ],
    );
}

#[test]
fn what_engine_shim_and_kernel_fail_at_is_the_nodes() {
    check(
        of_start,
        "",
        &[
            ("kubelet", "context deadline exceeded", Node),
            (
                "kubelet",
                "failed to prepare subPath for volumeMount \"logs\" of container \"agent-1\"",
                Node,
            ),
            (
                "containerd",
                "failed to reserve container name \"agent-1_sub-1-x_demo_1b2_0\": name \"agent-1_sub-1-x_demo_1b2_0\" is reserved for \"4f\"",
                Node,
            ),
            (
                "containerd",
                "failed to get sandbox container task: no running task found: task 4f not found",
                Node,
            ),
            (
                "containerd",
                "failed to create containerd container: failed to create prepare snapshot dir: mkdir \
                 /var/lib/containerd/io.containerd.snapshotter.v1.overlayfs/snapshots/new-3: no space left on device",
                Node,
            ),
            (
                "containerd",
                "failed to create containerd container: error unpacking image: failed to extract layer sha256:4f: read /data: input/output \
                 error",
                Node,
            ),
            (
                "containerd",
                "failed to create containerd task: failed to mount rootfs component: invalid argument",
                Node,
            ),
            (
                "shim",
                "failed to create containerd task: failed to create shim task: context deadline exceeded",
                Node,
            ),
            (
                "shim",
                "failed to create containerd task: failed to start shim: start failed: fork/exec \
                 /usr/bin/containerd-shim-runc-v2: resource temporarily unavailable",
                Node,
            ),
            (
                "shim",
                "failed to create shim task: OCI runtime create failed: unable to retrieve OCI runtime error (open \
                 /run/containerd/io.containerd.runtime.v2.task/k8s.io/4f/log.json: no such file or directory): exec: \
                 \"nvidia-container-runtime\": executable file not found in $PATH: unknown",
                Node,
            ),
            ("shim", "failed to create shim task: ttrpc: closed: unknown", Node),
            ("Docker", "", Node),
        ],
    );
    check(
        of_start,
        TASK,
        &[
            (
                "runc",
                "unable to start container process: can't get final child's PID from pipe: EOF: unknown",
                Node,
            ),
            ("runc", "pipe2: too many open files in system: unknown", Node),
            (
                "runc",
                "unable to start container process: unable to apply cgroup configuration: mkdir \
                 /sys/fs/cgroup/kubepods.slice/cri-containerd-4f.scope: no such file or directory: unknown",
                Node,
            ),
            (
                "runc",
                "unable to start container process: error during container init: error mounting \"/var/lib/kubelet/pods/1b2/etc-hosts\" to \
                 rootfs at \"/etc/hosts\": open /etc/hosts: no such file or directory: unknown",
                Node,
            ),
            // The first process is the operator's own, on a volume of the node: one that may not execute from it, for example.
            (
                "runc",
                "unable to start container process: exec: \"/leaderboard-tools/leaderboard-runner\": permission denied: unknown",
                Node,
            ),
        ],
    );
}

#[test]
fn an_image_is_missing_only_where_its_registry_has_looked_for_it() {
    check(
        of_pull,
        PULL,
        &[
            (
                "containerd",
                "failed to resolve reference \"r.example/team/agent:1\": r.example/team/agent:1: not found",
                ImageMissing,
            ),
            (
                "containerd",
                "no match for platform in manifest: not found",
                ImagePlatform,
            ),
            (
                "containerd",
                "unsupported media type application/vnd.oci.artifact.manifest.v1+json",
                ImageKind,
            ),
            (
                "containerd 2.1",
                "media type \"application/vnd.docker.distribution.manifest.v1+prettyjws\" is no longer supported since containerd v2.1, \
                 please rebuild the image as \"application/vnd.docker.distribution.manifest.v2+json\"",
                ImageKind,
            ),
        ],
    );
    check(
        of_pull,
        "",
        &[
            (
                "CRI-O",
                "initializing source docker://r.example/team/agent:1: reading manifest 1 in r.example/team/agent: manifest unknown",
                ImageMissing,
            ),
            (
                "CRI-O",
                "initializing source docker://r.example/team/agent:1: reading manifest 1 in r.example/team/agent: name unknown: \
                 Repository name not known to registry.",
                ImageMissing,
            ),
            (
                "CRI-O",
                "choosing image instance: no image found in image index for architecture \"amd64\", variant \"\", OS \"linux\"",
                ImagePlatform,
            ),
            (
                "Docker",
                "Error response from daemon: manifest for r.example/team/agent:1 not found: manifest unknown: manifest unknown",
                ImageMissing,
            ),
        ],
    );
}

#[test]
fn a_registry_that_refuses_or_does_not_answer_is_the_hosts_to_look_at() {
    let resolve = format!("{PULL}failed to resolve reference \"r.example/team/agent:1\": ");
    check(
        of_pull,
        &resolve,
        &[
            (
                "registry",
                "pulling from host r.example failed with status code [manifests 1]: 401 Unauthorized",
                Registry,
            ),
            (
                "registry",
                "unexpected status from HEAD request to https://r.example/v2/: 403 Forbidden",
                Registry,
            ),
            (
                "registry",
                "pull access denied, repository does not exist or may require authorization: server message: insufficient_scope: \
                 authorization failed",
                Registry,
            ),
            (
                "registry",
                "failed to authorize: failed to fetch oauth token: unexpected status: 404 Not Found",
                Registry,
            ),
            (
                "registry",
                "pulling from host r.example failed with status code [manifests 1]: 415 Unsupported Media Type",
                Registry,
            ),
            (
                "registry",
                "pulling from host r.example failed with status code [manifests 1]: 503 Service Unavailable",
                Registry,
            ),
            (
                "network",
                "failed to do request: Head \"https://r.example/v2/\": dial tcp: lookup r.example on 10.0.0.10:53: no such host",
                Registry,
            ),
            (
                "network",
                "failed to do request: Head \"https://r.example/v2/\": dial tcp: lookup r.example: host: not found",
                Registry,
            ),
            (
                "network",
                "failed to do request: Head \"https://r.example/v2/\": dial tcp 10.0.0.1:443: connect: connection refused",
                Registry,
            ),
        ],
    );
    check(
        of_pull,
        PULL,
        &[
            (
                "network",
                "failed to copy: read tcp 10.0.0.2:1->10.0.0.1:443: read: connection timed out",
                Registry,
            ),
            (
                "network",
                "failed to copy: httpReadSeeker: failed open: unexpected EOF",
                Registry,
            ),
            (
                "registry",
                "failed to copy: httpReadSeeker: failed open: content at https://r.example/v2/team/agent/blobs/sha256:4f not found: not \
                 found",
                Registry,
            ),
            (
                "containerd",
                "failed to copy: content digest sha256:4f: not found",
                Registry,
            ),
            (
                "proxy",
                "failed to unpack image on snapshotter overlayfs: unexpected media type text/html for sha256:4f: not found",
                Registry,
            ),
            (
                "disk",
                "failed to extract layer sha256:4f: write /data: no space left on device: unknown",
                Registry,
            ),
            (
                "disk",
                "failed to extract layer sha256:4f: input/output error: unknown",
                Registry,
            ),
            ("kubelet", "", Registry),
        ],
    );
}
