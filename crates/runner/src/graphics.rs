//! GPUs of the node as a container sees them before a simulator's server is started: how many devices, which of them is its own, and
//! whether the part of the driver is there that the server draws with. Knows the file system below a root, and no Unreal Engine.
//!
//! A server without a GPU would end with a message that names no cause, or draw in software for hours.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};

use thiserror::Error;

use leaderboard_protocol::graphics::{ADAPTER, INDEX, Needs};

/// Device nodes are called so, with the number behind.
const DEVICE: &str = "nvidia";
/// Where the Vulkan loader looks for the folder of drivers.
const DRIVER_PLACES: [&str; 5] = ["/etc/xdg", "/etc", "/usr/local/etc", "/usr/local/share", "/usr/share"];
/// Variables with more such places.
const PLACES_VARIABLES: [&str; 4] = ["XDG_CONFIG_HOME", "XDG_CONFIG_DIRS", "XDG_DATA_HOME", "XDG_DATA_DIRS"];
const DRIVER_FOLDER: &str = "vulkan/icd.d";
/// Variables by which the Vulkan loader is given its drivers; then it looks nowhere else.
const DRIVER_VARIABLES: [&str; 2] = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"];
/// Variable with drivers beyond those that it finds.
const MORE_DRIVERS: &str = "VK_ADD_DRIVER_FILES";
/// Beginning of the file name of NVIDIA's Vulkan driver; some distributions put the machine behind.
const DRIVER_FILE: &str = "nvidia_icd";
/// NVIDIA's OpenGL driver.
const LIBRARY: &str = "libGLX_nvidia.so.0";
/// Where the dynamic linker looks for libraries, below the root.
const LIBRARY_FOLDERS: [&str; 10] = [
    "usr/lib/x86_64-linux-gnu",
    "lib/x86_64-linux-gnu",
    "usr/lib/aarch64-linux-gnu",
    "usr/lib64",
    "lib64",
    "usr/lib",
    "usr/lib/x86_64-linux-gnu/nvidia/current",
    "usr/lib/nvidia",
    "usr/local/nvidia/lib",
    "usr/local/nvidia/lib64",
];
/// The linker's list of libraries, which holds their names as they are.
const LIBRARY_CACHE: &str = "etc/ld.so.cache";
const LIBRARY_VARIABLE: &str = "LD_LIBRARY_PATH";

/// Why a server cannot draw here.
#[derive(Debug, PartialEq, Eq, Error)]
pub enum NoGraphics {
    /// No device at all.
    #[error("the container sees no GPU (no /dev/nvidia0 or any other number), and its Leaderboard gives it one")]
    NoGpu,
    /// Devices, and no driver to draw with.
    #[error("the node's NVIDIA driver has no Vulkan/OpenGL part (nvidia_icd.json)")]
    DriverMissing,
}

/// The number of the graphics adapter of a container's own GPU. `variable` reads the container's environment.
pub fn adapter(root: &Path, needs: Needs, variable: impl Fn(&str) -> Option<OsString>) -> Result<usize, NoGraphics> {
    let devices = devices(root);
    if devices == 0 {
        return Err(NoGraphics::NoGpu);
    }
    let is_driven = match needs {
        Needs::Any => true,
        Needs::Vulkan => has_vulkan(root, &variable),
        Needs::OpenGl => has_opengl(root, &variable),
    };
    if !is_driven {
        return Err(NoGraphics::DriverMissing);
    }
    let index = variable(INDEX).and_then(|index| index.to_str()?.parse::<usize>().ok());
    // On a node with fewer GPUs than pairs, pairs share.
    Ok(index.unwrap_or(0) % devices)
}

/// GPUs that have a device node here.
pub fn devices(root: &Path) -> usize {
    let entries = fs::read_dir(root.join("dev")).into_iter().flatten().flatten();
    let is_device = |name: &OsStr| {
        let number = name.as_bytes().strip_prefix(DEVICE.as_bytes());
        number.is_some_and(|number| !number.is_empty() && number.iter().all(u8::is_ascii_digit))
    };
    entries
        .filter(|entry| is_device(&entry.file_name()))
        .filter(|entry| fs::metadata(entry.path()).is_ok_and(|found| found.file_type().is_char_device()))
        .count()
}

fn has_vulkan(root: &Path, variable: &impl Fn(&str) -> Option<OsString>) -> bool {
    let named = |name: &str| variable(name).filter(|value| !value.is_empty());
    let exists = |paths: OsString| std::env::split_paths(&paths).any(|path| below(root, &path).exists());
    if let Some(only) = DRIVER_VARIABLES.iter().find_map(|name| named(name)) {
        return exists(only);
    }
    let is_driver = |name: &OsStr| {
        let name = name.as_bytes();
        name.starts_with(DRIVER_FILE.as_bytes()) && name.ends_with(b".json")
    };
    let more: Vec<PathBuf> = PLACES_VARIABLES
        .iter()
        .filter_map(|name| named(name))
        .flat_map(|places| std::env::split_paths(&places).collect::<Vec<_>>())
        .collect();
    let places = DRIVER_PLACES.iter().map(PathBuf::from).chain(more);
    let folders = places.map(|place| below(root, &place).join(DRIVER_FOLDER));
    let mut files = folders.flat_map(|folder| fs::read_dir(folder).into_iter().flatten().flatten());
    // A link into a driver that is not there is none.
    named(MORE_DRIVERS).is_some_and(exists) || files.any(|file| is_driver(&file.file_name()) && file.path().exists())
}

fn has_opengl(root: &Path, variable: &impl Fn(&str) -> Option<OsString>) -> bool {
    let listed = fs::read(root.join(LIBRARY_CACHE)).is_ok_and(|cache| contains(&cache, LIBRARY.as_bytes()));
    let named = variable(LIBRARY_VARIABLE).unwrap_or_default();
    let named: Vec<PathBuf> = std::env::split_paths(&named)
        .map(|folder| below(root, &folder))
        .collect();
    let mut folders = LIBRARY_FOLDERS.iter().map(|folder| root.join(folder)).chain(named);
    listed || folders.any(|folder| folder.join(LIBRARY).exists())
}

fn contains(bytes: &[u8], part: &[u8]) -> bool {
    bytes.windows(part.len()).any(|window| window == part)
}

fn below(root: &Path, path: &Path) -> PathBuf {
    root.join(path.strip_prefix("/").unwrap_or(path))
}

/// Replaces `$(LEADERBOARD_GRAPHICS_ADAPTER)` in a word, and nothing else: the rest is Kubernetes', which has done it.
pub fn with_adapter(word: &OsStr, adapter: usize) -> OsString {
    use std::os::unix::ffi::OsStringExt;

    let (reference, number) = (format!("$({ADAPTER})"), adapter.to_string());
    let mut rest = word.as_bytes();
    let mut out = Vec::with_capacity(rest.len());
    while let Some(at) = rest
        .windows(reference.len())
        .position(|window| window == reference.as_bytes())
    {
        out.extend_from_slice(&rest[..at]);
        out.extend_from_slice(number.as_bytes());
        rest = &rest[at + reference.len()..];
    }
    out.extend_from_slice(rest);
    OsString::from_vec(out)
}

#[cfg(test)]
mod tests {
    use leaderboard_protocol::graphics::NotANeed;
    use std::os::unix::fs::symlink;

    use tempfile::TempDir;

    use super::*;

    type Variables<'a> = &'a [(&'a str, &'a str)];
    /// Files, variables, and whether the driver is there.
    type Driver<'a> = (&'a [&'a str], Variables<'a>, bool);
    /// Devices, the pair's index, and the adapter.
    type Choice<'a> = (&'a [&'a str], Option<&'a str>, Result<usize, NoGraphics>);

    /// A container's file system with these devices and files.
    struct Container(TempDir);

    impl Container {
        fn new(devices: &[&str], files: &[&str]) -> Self {
            let root = tempfile::tempdir().unwrap();
            fs::create_dir(root.path().join("dev")).unwrap();
            for device in devices {
                symlink("/dev/null", root.path().join("dev").join(device)).unwrap();
            }
            for file in files {
                let path = root.path().join(file);
                fs::create_dir_all(path.parent().unwrap()).unwrap();
                fs::write(path, "").unwrap();
            }
            Self(root)
        }

        fn adapter(&self, needs: Needs, variables: Variables<'_>) -> Result<usize, NoGraphics> {
            let variable = |name: &str| {
                let found = variables.iter().find(|(known, _)| *known == name);
                found.map(|(_, value)| OsString::from(value))
            };
            adapter(self.0.path(), needs, variable)
        }
    }

    #[test]
    fn the_pairs_own_device_is_chosen_of_those_that_are_there() {
        let all: Vec<String> = (0..12).map(|number| format!("nvidia{number}")).collect();
        let all: Vec<&str> = all.iter().map(String::as_str).collect();
        let cases: [Choice<'_>; 10] = [
            (&[], Some("0"), Err(NoGraphics::NoGpu)),
            (
                &["nvidiactl", "nvidia-uvm", "nvidia", "nvidia1x", "xnvidia0"],
                Some("0"),
                Err(NoGraphics::NoGpu),
            ),
            (&["nvidia0", "nvidiactl"], Some("0"), Ok(0)),
            // One device is adapter 0, whatever its number and the pair's.
            (&["nvidia2", "nvidiactl"], Some("2"), Ok(0)),
            (&["nvidia0", "nvidia1", "nvidia2", "nvidia3"], Some("2"), Ok(2)),
            (&["nvidia0", "nvidia1", "nvidia2", "nvidia3"], Some("3"), Ok(3)),
            (&["nvidia0", "nvidia1"], Some("3"), Ok(1)),
            (&["nvidia0", "nvidia1"], None, Ok(0)),
            (&["nvidia0", "nvidia1"], Some("-1"), Ok(0)),
            (&all, Some("11"), Ok(11)),
        ];
        for (devices, index, expected) in cases {
            let container = Container::new(devices, &[]);
            let variables: Vec<(&str, &str)> = index.map(|index| (INDEX, index)).into_iter().collect();
            assert_eq!(
                container.adapter(Needs::Any, &variables),
                expected,
                "{devices:?} {index:?}"
            );
        }
    }

    #[test]
    fn a_plain_file_is_no_device_and_no_folder_is_none() {
        let container = Container::new(&[], &["dev/nvidia0"]);
        assert_eq!(container.adapter(Needs::Any, &[]), Err(NoGraphics::NoGpu));
        fs::remove_dir_all(container.0.path().join("dev")).unwrap();
        assert_eq!(container.adapter(Needs::Any, &[]), Err(NoGraphics::NoGpu));
    }

    #[test]
    fn vulkan_needs_nvidias_driver_file() {
        let missing = Err(NoGraphics::DriverMissing);
        let cases: [Driver<'_>; 12] = [
            (&[], &[], false),
            (
                &["opt/share/vulkan/icd.d/nvidia_icd.json"],
                &[("XDG_DATA_DIRS", "/usr/share:/opt/share")],
                true,
            ),
            (&["opt/fake.json"], &[("VK_ADD_DRIVER_FILES", "/opt/fake.json")], true),
            (&["etc/vulkan/icd.d/nvidia_icd.json"], &[], true),
            (&["usr/share/vulkan/icd.d/nvidia_icd.json"], &[], true),
            (&["usr/share/vulkan/icd.d/nvidia_icd.x86_64.json"], &[], true),
            (&["usr/share/vulkan/icd.d/intel_icd.x86_64.json"], &[], false),
            (&["usr/share/vulkan/implicit_layer.d/nvidia_layers.json"], &[], false),
            (
                &["opt/fake.json"],
                &[("VK_ICD_FILENAMES", "/nowhere.json:/opt/fake.json")],
                true,
            ),
            (&["opt/fake.json"], &[("VK_DRIVER_FILES", "/opt/fake.json")], true),
            // The loader then looks nowhere else.
            (
                &["etc/vulkan/icd.d/nvidia_icd.json"],
                &[("VK_DRIVER_FILES", "/nowhere.json")],
                false,
            ),
            (&["etc/vulkan/icd.d/nvidia_icd.json"], &[("VK_ICD_FILENAMES", "")], true),
        ];
        for (files, variables, is_there) in cases {
            let container = Container::new(&["nvidia0"], files);
            let expected = if is_there { &Ok(0) } else { &missing };
            assert_eq!(
                &container.adapter(Needs::Vulkan, variables),
                expected,
                "{files:?} {variables:?}"
            );
            assert_eq!(container.adapter(Needs::Any, variables), Ok(0));
            assert_eq!(
                container.adapter(Needs::OpenGl, variables),
                Err(NoGraphics::DriverMissing)
            );
        }
    }

    #[test]
    fn a_driver_file_that_leads_nowhere_is_none() {
        let container = Container::new(&["nvidia0"], &["etc/vulkan/icd.d/other.json"]);
        let folder = container.0.path().join("etc/vulkan/icd.d");
        symlink("/nowhere/nvidia_icd.json", folder.join("nvidia_icd.json")).unwrap();
        assert_eq!(container.adapter(Needs::Vulkan, &[]), Err(NoGraphics::DriverMissing));
    }

    #[test]
    fn opengl_needs_nvidias_library() {
        let cases: [Driver<'_>; 6] = [
            (&[], &[], false),
            (&["usr/lib/x86_64-linux-gnu/libGLX_nvidia.so.0"], &[], true),
            (&["usr/lib64/libGLX_nvidia.so.0"], &[], true),
            (&["usr/lib64/libGLX_mesa.so.0"], &[], false),
            (
                &["opt/driver/libGLX_nvidia.so.0"],
                &[("LD_LIBRARY_PATH", "/a:/opt/driver")],
                true,
            ),
            (&["opt/driver/libGLX_nvidia.so.0"], &[], false),
        ];
        for (files, variables, is_there) in cases {
            let container = Container::new(&["nvidia0"], files);
            let found = container.adapter(Needs::OpenGl, variables);
            assert_eq!(found.is_ok(), is_there, "{files:?} {variables:?}: {found:?}");
        }
        let container = Container::new(&["nvidia0"], &["etc/ld.so.cache"]);
        let cache = b"glibc-ld.so.cache1.1\0libGLX_nvidia.so.0\0/opt/x/libGLX_nvidia.so.0\0";
        fs::write(container.0.path().join(LIBRARY_CACHE), cache).unwrap();
        assert_eq!(container.adapter(Needs::OpenGl, &[]), Ok(0));
    }

    #[test]
    fn a_word_gets_the_adapter_and_keeps_the_rest() {
        let cases = [
            (
                "r.GraphicsAdapter=$(LEADERBOARD_GRAPHICS_ADAPTER)",
                "r.GraphicsAdapter=3",
            ),
            ("$(LEADERBOARD_GRAPHICS_ADAPTER),$(LEADERBOARD_GRAPHICS_ADAPTER)", "3,3"),
            (
                "$$(x) $(date) $(LEADERBOARD_GRAPHICS_ADAPTE",
                "$$(x) $(date) $(LEADERBOARD_GRAPHICS_ADAPTE",
            ),
            ("", ""),
        ];
        for (word, expected) in cases {
            assert_eq!(with_adapter(OsStr::new(word), 3), expected, "{word}");
        }
    }

    #[test]
    fn what_a_server_draws_with_is_read_back() {
        for needs in [Needs::Any, Needs::Vulkan, Needs::OpenGl] {
            assert_eq!(needs.to_string().parse(), Ok(needs));
        }
        assert_eq!("directx".parse::<Needs>(), Err(NotANeed));
    }
}
