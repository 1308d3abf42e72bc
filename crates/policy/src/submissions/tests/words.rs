//! The cause of a failed start: `words.tsv` has words of kubelets, container engines, GPU toolkits, shims, runc and registries. Each row
//! has the cause that they show, their source, and the words.

use crate::submissions::cause::{Cause, of_config, of_pull, of_start};

/// Prefixes of the words of a row.
const PREFIXES: [(&str, &str); 3] = [
    (
        "TASK…",
        "failed to create containerd task: failed to create shim task: OCI runtime create failed: runc create failed: ",
    ),
    (
        "PULL…",
        "rpc error: code = Unknown desc = failed to pull and unpack image \"r.example/team/agent:1\": ",
    ),
    (
        "RESOLVE…",
        "rpc error: code = Unknown desc = failed to pull and unpack image \"r.example/team/agent:1\": \
         failed to resolve reference \"r.example/team/agent:1\": ",
    ),
];

/// Judges all rows of one part of the table.
fn check(part: &str, judge: impl Fn(&str) -> Cause) {
    let (_, rows) = include_str!("words.tsv").split_once(&format!("[{part}]\n")).unwrap();
    let rows = rows.lines().take_while(|row| !row.is_empty());
    for row in rows.filter(|row| !row.starts_with('#')) {
        let mut columns = row.splitn(3, '\t');
        let [cause, source, words] = [(); 3].map(|()| columns.next().unwrap_or_default());
        let after = |(mark, prefix): &(&str, &str)| Some(format!("{prefix}{}", words.strip_prefix(mark)?));
        let words = PREFIXES.iter().find_map(after).unwrap_or_else(|| words.to_owned());
        assert_eq!(format!("{:?}", judge(&words)), cause, "{source}: {words}");
    }
}

#[test]
fn a_setting_is_the_hosts_unless_the_kubelet_refuses_the_images_user() {
    check(
        "a_setting_is_the_hosts_unless_the_kubelet_refuses_the_images_user",
        of_config,
    );
}

#[test]
fn what_runc_misses_in_the_image_is_the_images() {
    check("what_runc_misses_in_the_image_is_the_images", of_start);
}

#[test]
fn what_the_gpu_toolkit_fails_at_is_the_nodes_though_it_misses_files() {
    check(
        "what_the_gpu_toolkit_fails_at_is_the_nodes_though_it_misses_files",
        of_start,
    );
}

#[test]
fn what_engine_shim_and_kernel_fail_at_is_the_nodes() {
    check("what_engine_shim_and_kernel_fail_at_is_the_nodes", of_start);
}

#[test]
fn an_image_is_missing_only_where_its_registry_has_looked_for_it() {
    check("an_image_is_missing_only_where_its_registry_has_looked_for_it", of_pull);
}

#[test]
fn a_registry_that_refuses_or_does_not_answer_is_the_hosts_to_look_at() {
    check(
        "a_registry_that_refuses_or_does_not_answer_is_the_hosts_to_look_at",
        of_pull,
    );
}
