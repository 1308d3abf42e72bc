//! The table of probes: each attack once.

use crate::probe::Probe;
use crate::{files, identity, kernel, processes};

/// The sections of the table, in its order.
pub const SECTIONS: [(&str, &[Probe]); 4] = [
    ("Identity and secrets", identity::PROBES),
    ("The runner and other processes", processes::PROBES),
    ("Kernel", kernel::PROBES),
    ("Files and devices", files::PROBES),
];

/// All probes, in their order.
pub fn probes() -> impl Iterator<Item = &'static Probe> {
    SECTIONS.iter().flat_map(|(_, probes)| probes.iter())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn each_probe_has_a_name_of_its_own_without_blanks() {
        let ids: BTreeSet<_> = probes().map(|probe| probe.id).collect();
        assert_eq!(ids.len(), probes().count());
        assert!(ids.iter().all(|id| !id.is_empty() && !id.contains(' ')), "{ids:?}");
    }
}
