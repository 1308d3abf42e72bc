//! Which namespaces a process serves.

use std::collections::BTreeSet;

use kube::core::NamespaceResourceScope;
use kube::{Api, Client};

use super::{Item, Watchable, guarded};

/// Which namespaces a process serves: it reads and writes nothing in any other one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Namespaces {
    All,
    Only(BTreeSet<String>),
}

impl Namespaces {
    /// Namespaces of the command line; none means all.
    pub fn of(names: impl IntoIterator<Item = String>) -> Self {
        let names: BTreeSet<String> = names.into_iter().filter(|name| !name.is_empty()).collect();
        if names.is_empty() { Self::All } else { Self::Only(names) }
    }

    /// Each of them; None stands for all at once.
    pub fn each(&self) -> Vec<Option<&str>> {
        match self {
            Self::All => vec![None],
            Self::Only(names) => names.iter().map(|name| Some(name.as_str())).collect(),
        }
    }

    /// The API of a kind, once for each namespace, or once for all.
    pub fn apis<K>(&self, client: &Client) -> Vec<Api<Item<K>>>
    where
        K: Watchable<Scope = NamespaceResourceScope>,
    {
        let api = |namespace| guarded(client.clone(), namespace);
        self.each().into_iter().map(api).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn none_is_all_and_each_counts_once() {
        let of = |names: &[&str]| Namespaces::of(names.iter().map(ToString::to_string));
        assert_eq!(of(&[]).each(), [None]);
        assert_eq!(of(&[""]).each(), [None]);
        assert_eq!(of(&["b", "a", "", "b"]).each(), [Some("a"), Some("b")]);
    }
}
