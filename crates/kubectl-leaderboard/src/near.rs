//! Names that a person may have meant. Pure; called for an unknown name.

/// Names that are offered.
const MOST: usize = 3;
/// How alike two names must be, of 1.
const ALIKE: f64 = 0.7;

/// The known names nearest to a wrong one, the best first. The number at the end of a name may stand for it.
pub(super) fn names(wrong: &str, known: &[String]) -> Vec<String> {
    let ending = format!("-{wrong}");
    let score = |name: &String| {
        if name.ends_with(&ending) {
            1.0
        } else {
            strsim::normalized_damerau_levenshtein(wrong, name)
        }
    };
    let mut found: Vec<(f64, &String)> = known.iter().map(|name| (score(name), name)).collect();
    found.retain(|(score, _)| *score >= ALIKE);
    found.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| a.1.cmp(b.1)));
    found.into_iter().take(MOST).map(|(_, name)| name.clone()).collect()
}

/// Where else to look for an object: in a namespace that has one of its name, under a name like it, or among all.
pub(super) fn next(kind: &str, wrong: &str, namespace: &str, known: &[String], elsewhere: &[String]) -> String {
    let near = names(wrong, known);
    match elsewhere {
        [other] => format!("There is one in namespace {other}: use -n {other}"),
        [first, ..] => format!(
            "There is one in each of the namespaces {}: use -n {first}",
            elsewhere.join(", ")
        ),
        [] if near.is_empty() => format!("`kubectl get {kind} -n {namespace}` lists all; use -n for another namespace"),
        [] => format!("Did you mean {}?", near.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_names_are_offered() {
        let known = [
            "submission-42",
            "submission-43",
            "baseline",
            "submission-142",
            "submission-7",
        ];
        let known = known.map(str::to_owned);
        for (wrong, expected) in [
            (
                "submision-42",
                &["submission-42", "submission-142", "submission-43"][..],
            ),
            ("42", &["submission-42"]),
            ("basline", &["baseline"]),
            ("something-else-entirely", &[]),
        ] {
            assert_eq!(names(wrong, &known), expected, "{wrong}");
        }
    }
}
