//! System calls by their number: the one place without the compiler's guarantees.
#![allow(
    unsafe_code,
    reason = "an attacker calls what no safe wrapper offers; every pointer given is null or outlives the call"
)]

use nix::errno::Errno;
use nix::libc::{self, c_long};

/// Calls the kernel. Pointers are given as addresses of what lives until the call has returned, or as 0.
pub(crate) fn call(number: c_long, arguments: [usize; 6]) -> Result<c_long, Errno> {
    let [first, second, third, fourth, fifth, sixth] = arguments;
    // SAFETY: the callers of this crate pass numbers, null, or addresses of buffers of their own that are as long as they say.
    Errno::result(unsafe { libc::syscall(number, first, second, third, fourth, fifth, sixth) })
}

/// Arguments of which the rest is 0.
pub(crate) fn of<const N: usize>(given: [usize; N]) -> [usize; 6] {
    let mut all = [0; 6];
    all[..N].copy_from_slice(&given);
    all
}

/// A negative number as the kernel takes it.
pub(crate) const fn negative(number: isize) -> usize {
    number.cast_unsigned()
}
