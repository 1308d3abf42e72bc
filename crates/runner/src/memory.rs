//! How often the kernel has killed a process of this container for lack of memory. Called by `run` before and after the
//! command: with cgroup v1 such a kill looks like any other death of a child. Guesses nothing where no counter is readable.

use std::fs;

const COUNTERS: [&str; 2] = [
    "/sys/fs/cgroup/memory.events",
    "/sys/fs/cgroup/memory/memory.oom_control",
];

/// The kernel's count so far; 0 when it shows none.
pub(crate) fn kills() -> u64 {
    COUNTERS
        .iter()
        .find_map(|path| count(&fs::read_to_string(path).ok()?))
        .unwrap_or(0)
}

fn count(events: &str) -> Option<u64> {
    events
        .lines()
        .find_map(|line| line.strip_prefix("oom_kill ")?.trim().parse().ok())
}

#[cfg(test)]
mod tests {
    use super::count;

    #[test]
    fn both_cgroup_versions_are_read() {
        assert_eq!(
            count("low 0\nhigh 0\nmax 12\noom 3\noom_kill 2\noom_group_kill 0\n"),
            Some(2)
        );
        assert_eq!(count("oom_kill_disable 0\nunder_oom 0\noom_kill 7\n"), Some(7));
        assert_eq!(count("oom_kill_disable 0\nunder_oom 0\n"), None);
    }
}
