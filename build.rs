//! Links the program of an image so that it takes less memory.

use std::env;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let is = |key: &str, value: &str| env::var(key).is_ok_and(|found| found == value);
    let is_glibc = is("CARGO_CFG_TARGET_OS", "linux") && is("CARGO_CFG_TARGET_ENV", "gnu");
    // The loader reads all relocations at the start, 24 bytes for each address unless they are packed. glibc knows the packed form
    // since 2.36, which the image has; what is built for this machine alone may meet an older one.
    if is_glibc && is("PROFILE", "release") {
        println!("cargo::rustc-link-arg-bins=-Wl,-z,pack-relative-relocs");
    }
}
