//! The cause of a start that fails, by the words of the kubelet, the container engine, the GPU toolkit, runc and the registries: one
//! table. Pure.
//!
//! Called by `cause` and `blame`. An image is the cause only where the words prove it. A node without disk, driver or memory must charge
//! nobody, and its words are endless; so what the table does not know is the node's, or the registry's.

use leaderboard_contract::run::TOOLS;

/// The cause that keeps a container from starting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Cause {
    /// The image runs as a user that the Pod's security context forbids, or cannot judge.
    ImageUser,
    /// The image lacks what is to run, may not run it, or has it for another machine.
    ImageProgram,
    /// The registry has no such image.
    ImageMissing,
    /// The registry has the image for other machines only.
    ImagePlatform,
    /// The registry has something of a kind that no container is made of.
    ImageKind,
    /// The text that was submitted is the name of no image.
    ImageName,
    /// The registry, or the way to it.
    Registry,
    /// The node: its kubelet, container engine, GPU toolkit, disk or memory.
    Node,
    /// The set-up of the challenge's hosts.
    Host,
}

impl Cause {
    /// True if another image would start.
    pub(super) fn is_images(self) -> bool {
        match self {
            Self::ImageUser
            | Self::ImageProgram
            | Self::ImageMissing
            | Self::ImagePlatform
            | Self::ImageKind
            | Self::ImageName => true,
            Self::Registry | Self::Node | Self::Host => false,
        }
    }
}

/// Words that all have to be there, and what they show. The first row that fits counts.
type Row = (&'static [&'static str], Cause);

/// `CreateContainerConfigError`: the kubelet's own words. The settings are the hosts', unless it is the image's user that is refused.
const CONFIGS: [Row; 2] = [
    (
        &["container has runAsNonRoot and image will run as root"],
        Cause::ImageUser,
    ),
    (
        &["container has runAsNonRoot and image has non-numeric user"],
        Cause::ImageUser,
    ),
];

/// `CreateContainerError`, `RunContainerError`, `StartError`, `ContainerCannotRun`; in small letters. The words of nodes stand first:
/// they quote programs and files of their own that are missing.
const STARTS: [Row; 19] = [
    // NVIDIA's toolkit, as the runtime of a container or as a hook of it.
    (&["nvidia-container-"], Cause::Node),
    (&["cdi device"], Cause::Node),
    (&["error running ", "hook"], Cause::Node),
    // containerd's shim, which starts runc itself.
    (&["unable to retrieve oci runtime error"], Cause::Node),
    (&["failed to start shim"], Cause::Node),
    // containerd and CRI-O, which look users and groups up in the image.
    (&["unable to find user "], Cause::ImageProgram),
    (&["unable to find group "], Cause::ImageProgram),
    (&["no users found"], Cause::ImageProgram),
    (&["no groups found"], Cause::ImageProgram),
    (&["/etc/passwd: no such file or directory"], Cause::ImageProgram),
    // runc, and crun: the first process of the container.
    (
        &["container process", " exec: \"", "no such file or directory"],
        Cause::ImageProgram,
    ),
    (
        &["container process", " exec: \"", "not found in $path"],
        Cause::ImageProgram,
    ),
    (
        &["container process", " exec: \"", "permission denied"],
        Cause::ImageProgram,
    ),
    (&["container process", "exec format error"], Cause::ImageProgram),
    (&["exec user process", "exec format error"], Cause::ImageProgram),
    (&["executable file `", "no such file or directory"], Cause::ImageProgram),
    (&["chdir to cwd (", "no such file or directory"], Cause::ImageProgram),
    (&["chdir to cwd (", "permission denied"], Cause::ImageProgram),
    (&["chdir to cwd (", "not a directory"], Cause::ImageProgram),
];

/// `ErrImagePull`, `ImagePullBackOff`. An image is missing only where the registry itself has looked for it. A host, a token or a layer that
/// is `not found` is the registry's, and what containerd has lost the node's.
const PULLS: [Row; 10] = [
    (&["failed to do request"], Cause::Registry),
    (&["failed to authorize"], Cause::Registry),
    (&["no match for platform"], Cause::ImagePlatform),
    (
        &["no image found in image index for architecture"],
        Cause::ImagePlatform,
    ),
    (
        &["no image found in manifest list for architecture"],
        Cause::ImagePlatform,
    ),
    (&["manifest unknown"], Cause::ImageMissing),
    (&["name unknown"], Cause::ImageMissing),
    (&["failed to resolve reference", ": not found"], Cause::ImageMissing),
    (&["unsupported media type"], Cause::ImageKind),
    (
        &["media type", "is no longer supported since containerd"],
        Cause::ImageKind,
    ),
];

/// Why the kubelet cannot set a container up.
pub(super) fn of_config(words: &str) -> Cause {
    first(&CONFIGS, words).unwrap_or(Cause::Host)
}

/// Why a container cannot be made, or its first process not be started.
pub(super) fn of_start(words: &str) -> Cause {
    // The first process is the operator's own runner: an image can neither lack it nor forbid it.
    if ['"', '`']
        .iter()
        .any(|quote| words.contains(&format!("{quote}{TOOLS}/")))
    {
        return Cause::Node;
    }
    first(&STARTS, &words.to_ascii_lowercase()).unwrap_or(Cause::Node)
}

/// Why an image cannot be pulled.
pub(super) fn of_pull(words: &str) -> Cause {
    first(&PULLS, words).unwrap_or(Cause::Registry)
}

fn first(rows: &[Row], words: &str) -> Option<Cause> {
    let is_there = |signs: &[&str]| signs.iter().all(|sign| words.contains(sign));
    rows.iter().find(|(signs, _)| is_there(signs)).map(|(_, cause)| *cause)
}
