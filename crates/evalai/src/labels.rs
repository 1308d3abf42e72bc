//! Comparison of a Leaderboard with its challenge: phases, splits and metrics.
//!
//! Called by `hub` with what `queue` has read. Pure.

use std::collections::BTreeMap;

use jiff::Timestamp;

use super::row::{Challenge, Phase, Split};
use super::types::{Metrics, Target};
use leaderboard_api::{Order, Ranking};

/// A challenge as EvalAI shows it.
#[derive(Clone, Debug, PartialEq)]
pub struct Catalog {
    /// When it was read.
    pub at: Timestamp,
    /// Its phases.
    pub phases: Vec<Phase>,
    /// Its leaderboards.
    pub splits: Vec<Split>,
    /// Codenames of dataset splits; none where EvalAI does not show them.
    pub codenames: BTreeMap<i64, Option<String>>,
    /// Whether the highest value leads, by the ids of leaderboards whose schemas leave it open; none where EvalAI does not show it.
    pub descending: BTreeMap<i64, Option<bool>>,
    /// Read for a Leaderboard that takes files.
    pub settings: Challenge,
}

/// How a Leaderboard fits its challenge.
#[derive(Clone, Debug, PartialEq)]
pub struct Labels {
    /// When EvalAI was read.
    pub at: Timestamp,
    /// Differences, in the order in which they were found.
    pub problems: Vec<Misfit>,
    /// How each phase ranks, where its leaderboard names a metric.
    pub rankings: BTreeMap<i64, Ranking>,
}

impl Labels {
    /// True if results can be published.
    pub fn ok(&self) -> bool {
        self.problems.iter().all(|problem| !problem.prevents())
    }
}

/// Something that does not fit.
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
pub enum Misfit {
    /// A track's phase is not the challenge's.
    #[error("challenge {challenge} has no phase {phase}; check evalai.challenge and the tracks' phases")]
    Phase { challenge: i64, phase: i64 },
    /// A phase has no leaderboard of that split.
    #[error("phase {phase} has no leaderboard for the split {split}; check evalai.split")]
    Split { phase: i64, split: String },
    /// A phase has no leaderboard, or one of a split without a name: what is to be sent for it is not known.
    #[error(
        "EvalAI shows no leaderboard of phase {phase}, or not the codename of each; add one there, or let the token's user read them"
    )]
    Unnamed { phase: i64 },
    /// The leaderboard lacks metrics: EvalAI would refuse every result.
    #[error("the leaderboard of phase {phase} has no {}; add these labels to its schema", .labels.join(", "))]
    Unknown { phase: i64, labels: Vec<String> },
    /// The leaderboard has metrics that are never sent: EvalAI shows them as `#`.
    #[error("the leaderboard of phase {phase} also has {}, which the operator never sends and which stay empty; remove them from its schema, or check evaluation.carla.version", .labels.join(", "))]
    Unsent { phase: i64, labels: Vec<String> },
    /// EvalAI's own worker takes the submissions, too.
    #[error(
        "challenge {challenge} has remote_evaluation: false in EvalAI, so that EvalAI's own worker would evaluate its submissions; set it to true there"
    )]
    NotRemote { challenge: i64 },
    /// Its submissions are no files.
    #[error(
        "challenge {challenge} has is_static_dataset_code_upload: true in EvalAI, so that its submissions are images and none starts here; set it to false there, or serve the challenge in the mode Batch"
    )]
    StaticCodeUpload { challenge: i64 },
}

impl Misfit {
    /// True if it keeps results from being published.
    fn prevents(&self) -> bool {
        !matches!(
            self,
            Self::Unsent { .. } | Self::NotRemote { .. } | Self::StaticCodeUpload { .. }
        )
    }
}

/// Compares a Leaderboard with its challenge.
pub fn compare(target: &Target, catalog: &Catalog) -> Labels {
    let challenge = target.challenge;
    let of_files = |is_so: bool, misfit| (target.takes_files && is_so).then_some(misfit);
    let not_remote = of_files(!catalog.settings.is_remote, Misfit::NotRemote { challenge });
    let is_static = catalog.settings.is_static_code_upload();
    let images = of_files(is_static, Misfit::StaticCodeUpload { challenge });
    Labels {
        at: catalog.at,
        problems: target
            .phases
            .iter()
            .flat_map(|phase| compare_phase(target, catalog, *phase))
            .chain(not_remote)
            .chain(images)
            .collect(),
        rankings: target
            .phases
            .iter()
            .filter_map(|phase| Some((*phase, ranking(catalog, ranked(target, catalog, *phase)?)?)))
            .collect(),
    }
}

/// The leaderboard that ranks a phase.
fn ranked<'a>(target: &'a Target, catalog: &'a Catalog, phase: i64) -> Option<&'a Split> {
    let split = match &target.metrics {
        Metrics::Fixed(_) => Some(&target.split),
        Metrics::Listed(scores) => scores.get(&phase)?.as_ref(),
    };
    match (split, named(target, catalog, phase).as_slice()) {
        (Some(split), _) => split_of(target, catalog, phase, split),
        (None, [(_, only)]) => Some(*only),
        (None, _) => None,
    }
}

/// How a leaderboard ranks. EvalAI's own default is that the highest value leads.
fn ranking(catalog: &Catalog, split: &Split) -> Option<Ranking> {
    let metric = split.schema.default_order_by.as_deref()?;
    let order = split.schema.order(metric).unwrap_or_else(|| {
        let is_descending = catalog.descending.get(&split.id).copied().flatten();
        if is_descending.unwrap_or(true) {
            Order::Descending
        } else {
            Order::Ascending
        }
    });
    Some(Ranking {
        metric: metric.to_owned(),
        order,
    })
}

fn compare_phase(target: &Target, catalog: &Catalog, phase: i64) -> Vec<Misfit> {
    if !catalog.phases.iter().any(|known| known.id == phase) {
        let challenge = target.challenge;
        return vec![Misfit::Phase { challenge, phase }];
    }
    let labels = match &target.metrics {
        Metrics::Listed(_) if listed(target, catalog, phase).is_none() => return vec![Misfit::Unnamed { phase }],
        // What a result lacks is known once it is there.
        Metrics::Listed(_) => return Vec::new(),
        Metrics::Fixed(labels) => labels,
    };
    let Some(split) = split_of(target, catalog, phase, &target.split) else {
        let split = target.split.clone();
        return vec![Misfit::Split { phase, split }];
    };
    let known = &split.schema.labels;
    let unknown: Vec<_> = labels.iter().filter(|label| !known.contains(label)).cloned().collect();
    let unsent: Vec<_> = known.iter().filter(|label| !labels.contains(label)).cloned().collect();
    let unknown = (!unknown.is_empty()).then_some(Misfit::Unknown { phase, labels: unknown });
    let unsent = (!unsent.is_empty()).then_some(Misfit::Unsent { phase, labels: unsent });
    unknown.into_iter().chain(unsent).collect()
}

/// The phase's leaderboard of a split.
fn split_of<'a>(target: &'a Target, catalog: &'a Catalog, phase: i64, codename: &str) -> Option<&'a Split> {
    let mut all = named(target, catalog, phase).into_iter();
    all.find_map(|(name, split)| (name == Some(codename)).then_some(split))
}

/// Each split of a phase with its codename. None where the phase has none, or a split has no codename.
pub(super) fn listed<'a>(target: &'a Target, catalog: &'a Catalog, phase: i64) -> Option<Vec<(&'a str, &'a Split)>> {
    let all = named(target, catalog, phase).into_iter();
    let all: Option<Vec<_>> = all.map(|(name, split)| Some((name?, split))).collect();
    all.filter(|all| !all.is_empty())
}

/// The leaderboards of a phase with the codenames of their splits. Where EvalAI does not show that of a phase's only one, it is the target's.
fn named<'a>(target: &'a Target, catalog: &'a Catalog, phase: i64) -> Vec<(Option<&'a str>, &'a Split)> {
    let of_phase = || catalog.splits.iter().filter(|split| split.phase == phase);
    let own = Some(target.split.as_str()).filter(|_| of_phase().count() == 1);
    let shown = |split: &Split| catalog.codenames.get(&split.dataset_split).and_then(Option::as_deref);
    of_phase().map(|split| (shown(split).or(own), split)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::row::Schema;
    use crate::token::Token;
    use serde_json::{Value, json};
    use std::sync::Arc;
    use std::time::Duration;

    fn target(phases: &[i64], labels: &[&str]) -> Target {
        Target {
            leaderboard: leaderboard_base::object_key::ObjectKey {
                namespace: "ns".into(),
                name: "board".into(),
                uid: "board".into(),
            },
            api_server: "http://evalai".into(),
            challenge: 1,
            split: "leaderboard".into(),
            token: Arc::new(Token::parse("x").unwrap()),
            requests_per_minute: 54,
            sweep: Duration::from_mins(1),
            period: Duration::from_secs(10),
            phases: phases.into(),
            metrics: Metrics::Fixed(labels.iter().map(|label| (*label).to_owned()).collect()),
            inbox: None,
            is_observed: false,
            takes_files: false,
            since: Timestamp::UNIX_EPOCH,
        }
    }

    fn catalog(codename: Option<&str>) -> Catalog {
        let split = |phase, dataset_split, labels: &[&str]| Split {
            id: phase,
            phase,
            dataset_split,
            schema: Schema {
                labels: labels.iter().map(|label| (*label).to_owned()).collect(),
                default_order_by: Some("A".into()),
                metadata: Value::Null,
            },
        };
        Catalog {
            at: Timestamp::UNIX_EPOCH,
            phases: [(1, false), (2, true)]
                .map(|(id, shows_partial)| Phase { id, shows_partial })
                .into(),
            splits: vec![split(1, 10, &["A", "B"]), split(2, 11, &["A", "B", "C"])],
            codenames: [(10, codename.map(str::to_owned)), (11, None)].into(),
            descending: BTreeMap::new(),
            settings: Challenge::default(),
        }
    }

    #[test]
    fn each_phase_ranks_as_its_schema_says_then_as_its_leaderboard_is_set() {
        let of = |schema: Value, descending| {
            let mut catalog = catalog(Some("leaderboard"));
            catalog.splits[0].schema = serde_json::from_value(schema).unwrap();
            catalog.descending = descending;
            compare(&target(&[1], &["A"]), &catalog).rankings.remove(&1)
        };
        let ranking = |metric: &str, order| {
            let metric = metric.to_owned();
            Some(Ranking { metric, order })
        };
        let plain = || json!({"labels": ["A", "B"], "default_order_by": "B"});
        let says = |ascending: Value| {
            let about = json!({"B": {"sort_ascending": ascending}});
            json!({"labels": ["A", "B"], "default_order_by": "B", "metadata": about})
        };
        for (schema, descending, expected) in [
            (plain(), vec![], ranking("B", Order::Descending)),
            (plain(), vec![(1, None)], ranking("B", Order::Descending)),
            (plain(), vec![(1, Some(true))], ranking("B", Order::Descending)),
            (plain(), vec![(1, Some(false))], ranking("B", Order::Ascending)),
            (says(json!(true)), vec![(1, Some(true))], ranking("B", Order::Ascending)),
            (
                says(json!(false)),
                vec![(1, Some(false))],
                ranking("B", Order::Descending),
            ),
            (json!({"labels": ["A"]}), vec![], None),
        ] {
            assert_eq!(
                of(schema.clone(), descending.into_iter().collect()),
                expected,
                "{schema}"
            );
        }
        let other = compare(&target(&[2, 3], &["A"]), &catalog(Some("leaderboard")));
        assert_eq!(other.rankings.keys().collect::<Vec<_>>(), [&2]);
    }

    /// One whose phase has the splits `dev` and `test`, and whose leaderboards rank by `A`.
    fn of_two_splits(codenames: [Option<&str>; 2]) -> Catalog {
        let mut catalog = catalog(None);
        catalog.splits[1].phase = 1;
        let names = [10, 11].into_iter().zip(codenames);
        catalog.codenames = names.map(|(id, name)| (id, name.map(str::to_owned))).collect();
        catalog.descending = [(2, Some(false))].into();
        catalog
    }

    fn takes_what_is_listed(split: Option<&str>) -> Target {
        let scores = [1, 3].map(|phase| (phase, split.map(str::to_owned)));
        Target {
            metrics: Metrics::Listed(Arc::new(scores.into())),
            ..target(&[1], &[])
        }
    }

    #[test]
    fn where_the_labels_are_evalais_each_split_of_a_phase_needs_its_codename() {
        let (dev, test) = (Some("dev"), Some("test"));
        let unnamed = || vec![Misfit::Unnamed { phase: 1 }];
        let missing = vec![Misfit::Phase { challenge: 1, phase: 3 }];
        let bare = Catalog {
            splits: vec![],
            ..of_two_splits([dev, test])
        };
        for (catalog, phase, expected) in [
            (of_two_splits([dev, test]), 1, vec![]),
            (of_two_splits([dev, None]), 1, unnamed()),
            (of_two_splits([None, None]), 1, unnamed()),
            (bare, 1, unnamed()),
            (of_two_splits([dev, test]), 3, missing),
            (catalog(None), 1, vec![]),
        ] {
            let target = Target {
                phases: [phase].into(),
                ..takes_what_is_listed(None)
            };
            let found = compare(&target, &catalog);
            assert_eq!((found.ok(), found.problems), (expected.is_empty(), expected));
        }
    }

    #[test]
    fn where_the_labels_are_evalais_the_split_with_the_score_ranks() {
        let both = || of_two_splits([Some("dev"), Some("test")]);
        for (split, catalog, expected) in [
            (Some("dev"), both(), Some(Order::Descending)),
            (Some("test"), both(), Some(Order::Ascending)),
            (Some("val"), both(), None),
            // Which of them has the score is not known.
            (None, both(), None),
            (None, catalog(Some("test")), Some(Order::Descending)),
            (Some("test"), catalog(Some("test")), Some(Order::Descending)),
        ] {
            let found = compare(&takes_what_is_listed(split), &catalog).rankings.remove(&1);
            let metric = "A".to_owned();
            assert_eq!(found, expected.map(|order| Ranking { metric, order }), "{split:?}");
        }
    }

    #[test]
    fn a_leaderboard_that_takes_files_names_a_challenge_that_evalais_own_worker_evaluates_or_that_has_images() {
        let (remote, challenge) = (Challenge::default(), 1);
        let local = Challenge {
            is_remote: false,
            ..remote
        };
        let of_images = Challenge {
            is_static: true,
            ..remote
        };
        for (takes_files, settings, expected) in [
            (true, local, Some(Misfit::NotRemote { challenge })),
            (true, remote, None),
            (true, of_images, Some(Misfit::StaticCodeUpload { challenge })),
            (false, local, None),
            (false, remote, None),
            (false, of_images, None),
        ] {
            let target = Target {
                takes_files,
                ..target(&[1], &["A", "B"])
            };
            let catalog = Catalog {
                settings,
                ..catalog(Some("leaderboard"))
            };
            let found = compare(&target, &catalog);
            assert_eq!(found.problems, Vec::from_iter(expected), "{takes_files} {settings:?}");
            assert!(found.ok(), "results are published all the same");
        }
    }

    #[test]
    fn what_fits_is_ok_and_what_does_not_is_named() {
        let of = |phases: &[i64], labels: &[&str], codename| compare(&target(phases, labels), &catalog(codename));
        assert_eq!(of(&[1], &["A", "B"], Some("leaderboard")).problems, []);
        assert_eq!(
            of(&[1], &["A", "B"], None).problems,
            [],
            "a phase's only leaderboard is taken"
        );
        let unsent = Misfit::Unsent {
            phase: 2,
            labels: vec!["C".into()],
        };
        let found = of(&[1, 2], &["A", "B"], Some("leaderboard"));
        assert!(found.ok() && found.problems == [unsent], "{found:?}");
        for (phases, labels, codename, text) in [
            (
                &[3][..],
                &["A", "B"][..],
                Some("leaderboard"),
                "challenge 1 has no phase 3",
            ),
            (
                &[1],
                &["A", "B"],
                Some("test"),
                "no leaderboard for the split leaderboard",
            ),
            (&[1], &["A", "B", "D", "E"], Some("leaderboard"), "has no D, E"),
        ] {
            let found = of(phases, labels, codename);
            assert!(!found.ok() && found.problems[0].to_string().contains(text), "{found:?}");
        }
    }
}
