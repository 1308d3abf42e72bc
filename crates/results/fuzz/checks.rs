//! Checks that hold for any bytes. The fuzz targets run these, and the crate's own tests replay the corpus with them.
//!
//! A failed check panics, which is what both look for.

use leaderboard_results::{
    Checkpoint, Files, Format, Merged, Metric, Outcome, Plan, Refusal, Score, Slice, Source, Strictness, Verify,
    merge as merge_workers, metrics, offline, read_worker, render,
};

const FORMATS: [Format; 2] = [Format::V1, Format::V2];
const STRICTNESSES: [Strictness; 2] = [Strictness::Offline, Strictness::Pod];
/// Files of one input of [`merge`], and what stands between them: a byte that no JSON has.
const WORKERS: usize = 4;
const SEPARATOR: u8 = 0;

/// Outcome of an input, over all its readings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Seen {
    /// It was taken at least once.
    pub taken: bool,
    /// It was refused at least once.
    pub refused: bool,
    /// It was the whole run at least once.
    pub is_final: bool,
}

impl Seen {
    fn and(&mut self, other: Self) {
        self.taken |= other.taken;
        self.refused |= other.refused;
        self.is_final |= other.is_final;
    }

    fn refused() -> Self {
        Self {
            refused: true,
            ..Self::default()
        }
    }
}

/// One file of any bytes.
pub fn checkpoint(data: &[u8]) -> Seen {
    let mut seen = Seen::default();
    for format in FORMATS {
        let [lenient, strict] = STRICTNESSES.map(|strictness| {
            let plan = Plan {
                strictness,
                verify: Verify::Warn,
                ..Plan::lenient(format)
            };
            let read = read_worker(&plan, 1, data);
            match &read {
                Err(refusal) => check_refusal(refusal),
                Ok(None) => {}
                Ok(Some(worker)) => {
                    assert!(worker.done() <= 10_000 && worker.total() <= 1_000_000);
                    worker.warnings().iter().for_each(|warning| check_sentence(warning));
                    seen.and(merged(&plan, &[Some(worker)]));
                }
            }
            seen.refused |= read.is_err();
            read
        });
        if let Ok(Some(strict)) = strict {
            let taken = lenient.is_ok_and(|lenient| lenient.is_some_and(|lenient| lenient.total() == strict.total()));
            assert!(taken, "a pod takes what is not taken offline");
        }
    }
    seen
}

/// A byte of switches, then up to four files with a zero byte between them; an empty one is absent.
pub fn merge(data: &[u8]) -> Seen {
    let Some((switches, rest)) = data.split_first() else {
        return Seen::default();
    };
    let files: Vec<Option<Vec<u8>>> = rest
        .splitn(WORKERS, |byte| *byte == SEPARATOR)
        .map(|file| (!file.is_empty()).then(|| file.to_vec()))
        .collect();
    let verify = match switches >> 1 & 3 {
        0 => Verify::Disabled,
        1 => Verify::Refuse,
        _ => Verify::Warn,
    };
    let repetitions = u32::from(switches >> 3 & 3) + 1;
    let mut seen = Seen::default();
    for format in FORMATS {
        for strictness in STRICTNESSES {
            let loose = Plan {
                strictness,
                verify,
                as_original: switches & 1 == 1,
                ..Plan::lenient(format)
            };
            seen.and(run(&loose, &files));
            seen.and(run(&with_slices(&loose, repetitions, &files), &files));
        }
    }
    seen
}

/// The plan these files might have been made for: each promises its share.
fn with_slices(plan: &Plan, repetitions: u32, files: &[Option<Vec<u8>>]) -> Plan {
    let mut pairs = Vec::new();
    let mut first = 0;
    for (pair, file) in files.iter().enumerate() {
        let read = file
            .as_ref()
            .map(|file| read_worker(&Plan::lenient(plan.format), pair, file));
        let total = match read {
            Some(Ok(Some(worker))) => worker.total(),
            _ => 0,
        };
        let routes = if total < repetitions { 1 } else { total / repetitions };
        pairs.push(Slice {
            first,
            last: first + routes - 1,
        });
        first += routes;
    }
    Plan {
        pairs,
        routes: first,
        repetitions,
        ..plan.clone()
    }
}

fn run(plan: &Plan, files: &[Option<Vec<u8>>]) -> Seen {
    let mut workers = Vec::new();
    for (pair, file) in files.iter().enumerate() {
        match file.as_ref().map(|file| read_worker(plan, pair, file)).transpose() {
            Ok(read) => workers.push(read.flatten()),
            Err(refusal) => {
                check_refusal(&refusal);
                let again = offline(plan, files).err().map(|again| again.to_string());
                assert_eq!(again, Some(refusal.to_string()));
                return Seen::refused();
            }
        }
    }
    let workers: Vec<Option<&Checkpoint>> = workers.iter().map(Option::as_ref).collect();
    let seen = merged(plan, &workers);
    if !plan.pairs.is_empty() && !plan.as_original {
        for pair in 0..workers.len() {
            let mut fewer = workers.clone();
            fewer[pair] = None;
            if let Ok(merged) = merge_workers(plan, &fewer) {
                assert!(!merged.is_final, "final without pair {}", pair + 1);
            }
        }
    }
    let whole = offline(plan, files);
    assert_eq!(whole.is_ok(), seen.taken);
    seen
}

/// Merges and renders twice.
fn merged(plan: &Plan, workers: &[Option<&Checkpoint>]) -> Seen {
    let twice = [(); 2].map(|()| {
        merge_workers(plan, workers).and_then(|merged| {
            let files = render(plan, Some(&merged))?;
            Ok((merged, files))
        })
    });
    match twice {
        [Ok((merged, files)), Ok((other, again))] => {
            assert_eq!((&merged.text, &files), (&other.text, &again), "twice is not the same");
            check_merged(plan, workers.len(), &merged);
            check_files(plan, &merged, &files);
            check_reading_back(plan, &merged);
            Seen {
                taken: true,
                is_final: merged.is_final,
                refused: false,
            }
        }
        [Err(refusal), Err(again)] => {
            check_refusal(&refusal);
            assert_eq!(refusal.to_string(), again.to_string());
            Seen::refused()
        }
        _ => unreachable!("taken once and refused once"),
    }
}

fn check_merged(plan: &Plan, workers: usize, merged: &Merged) {
    let is_plain = |byte: u8| byte == b'\n' || (b' '..=b'~').contains(&byte);
    assert!(merged.text.bytes().all(is_plain) && merged.text.ends_with('}'));
    assert_eq!(merged.pairs.len(), workers);
    merged.warnings.iter().for_each(|warning| check_sentence(warning));
    if merged.is_final {
        assert!(merged.total > 0 && merged.done == merged.total && merged.score.is_some());
        assert!(merged.outcome != Outcome::Running);
    } else {
        assert!(!merged.eligible && merged.score.is_none());
        assert_eq!(
            (merged.outcome, merged.entry_status.as_str()),
            (Outcome::Running, "Started")
        );
    }
    assert!(!merged.eligible || merged.outcome == Outcome::Finished);
    assert_eq!(merged.eligible, merged.is_final && merged.outcome.why_not().is_none());
    assert!(merged.partial_score.is_none_or(f64::is_finite));
    if plan.strictness == Strictness::Pod {
        let is_percent = |score: Option<f64>| score.is_none_or(|score| (0.0..=100.0).contains(&score));
        assert!(is_percent(merged.score) && is_percent(merged.partial_score));
    }
}

fn check_files(plan: &Plan, merged: &Merged, files: &Files) {
    assert_eq!(files.metadata_json.as_deref(), Some(merged.text.as_str()));
    assert!(!(merged.is_final && files.partial_json.is_some()));
    let mut from = 0;
    let mut names: Vec<&str> = metrics(plan.format).iter().map(|metric| metric.name).collect();
    if plan.format == Format::V1 {
        names.sort_unstable();
    }
    for name in names {
        let place = files.results_json[from..].find(&format!("\"{name}\": "));
        assert!(place.is_some(), "{name} is not in its place");
        from += place.unwrap_or_default();
    }
    if plan.strictness == Strictness::Pod {
        check_closed(&files.stdout_txt);
        let results: serde_json::Value = serde_json::from_str(&files.results_json).unwrap_or_default();
        for metric in metrics(plan.format) {
            check_metric(metric, &results[0]["accuracies"][metric.name], merged.is_final);
        }
    }
}

fn check_metric(metric: &Metric, value: &serde_json::Value, is_final: bool) {
    let number = value.as_f64().unwrap_or(f64::NAN);
    // A penalty above 1 is what driving faster than the traffic earns in V2.
    let is_bounded = matches!(
        metric.source,
        Source::Score(Score::Composed | Score::Route | Score::Penalty)
    );
    let highest = if is_bounded { 100.0 } else { f64::MAX };
    assert!((0.0..=highest).contains(&number), "{}: {value}", metric.name);
    assert!(is_final || value.as_i64() == Some(0), "{}: {value}", metric.name);
}

/// The merged file is a checkpoint, and merging it again changes nothing.
fn check_reading_back(plan: &Plan, merged: &Merged) {
    let again = Plan {
        as_original: plan.as_original,
        ..Plan::lenient(plan.format)
    };
    // A plan, or a pod's rule for crashed routes, knows better than the totals of the files what is complete.
    let is_loose = plan.pairs.is_empty() && plan.strictness == Strictness::Offline;
    let read_back = |text: &str| offline(&again, &[Some(text.as_bytes().to_vec())]);
    let second = match read_back(&merged.text) {
        Ok((second, _)) => second,
        // Larger than one file may be, or summed up in another order.
        Err(Refusal::Limit { .. } | Refusal::Statistics { .. }) => return,
        // Only complete runs are searched for gaps.
        Err(Refusal::Gap { .. } | Refusal::Duplicate { .. }) if !is_loose => return,
        Err(refusal) => unreachable!("what was written is refused: {refusal}"),
    };
    if !is_loose {
        return;
    }
    assert_eq!((second.done, second.total), (merged.done, merged.total));
    assert_eq!(second.is_final, merged.is_final);
    // The merged file calls a run without sensors invalid, also one whose workers had named them.
    assert!(second.outcome == merged.outcome || merged.entry_status == "Invalid");
    if plan.format == Format::V2 {
        assert_eq!(second.text, merged.text);
    } else if let Ok((third, _)) = read_back(&second.text) {
        // V1 sums up in the order of the workers' files, which are one from now on.
        assert_eq!(third.text, second.text);
    }
}

fn check_refusal(refusal: &Refusal) {
    check_sentence(&refusal.to_string());
    let next = refusal.next_step();
    check_sentence(next);
    assert!(next.ends_with('.'), "{next:?}");
}

/// One line for people: none of the agent's own words, and nothing that only a debugger would print.
fn check_sentence(text: &str) {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || " _.,:;`'\"()+-<>/".contains(c);
    assert!(
        text.len() > 10 && text.len() < 300 && text.chars().all(is_plain),
        "{text:?}"
    );
    for debug in ["::", "Some(", "None", "Err(", "Ok(", "Int(", "Float("] {
        assert!(!text.contains(debug), "{text:?}");
    }
}

const STATUSES: [&str; 11] = [
    "Perfect",
    "Completed",
    "Started",
    "Failed",
    "Failed - Agent timed out",
    "Failed - Agent deviated from the route",
    "Failed - Agent got blocked",
    "Failed - Agent couldn't be set up",
    "Failed - Agent crashed",
    "Failed - Agent's sensors were invalid",
    "Failed - Simulation crashed",
];

/// EvalAI's summary holds only texts of closed sets.
pub fn check_closed(stdout: &str) {
    let is_number = |text: &str| text.trim_end_matches('x').parse::<f64>().is_ok_and(f64::is_finite);
    let is_route = |id: &str| {
        let numbers = id
            .strip_prefix("RouteScenario_")
            .map(|rest| rest.replacen("_rep", "", 1));
        numbers.is_some_and(|numbers| numbers.bytes().all(|byte| byte.is_ascii_digit()))
    };
    for line in stdout.lines() {
        let is_closed = match line.trim_start_matches([' ', '-']).split_once(": ") {
            Some(("Route ID", id)) => is_route(id),
            Some(("Status", status)) => STATUSES.contains(&status),
            Some((_, value)) => is_number(value),
            None => line.chars().all(|c| c.is_ascii_alphanumeric() || " +-:.'".contains(c)),
        };
        assert!(is_closed, "{line:?}");
    }
}
