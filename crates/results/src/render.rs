//! EvalAI's files: results.json, stdout.txt, metadata.json. Called with the merge's outcome each round, byte for byte what
//! the original's rendering scripts write.

use std::fmt::{self, Write as _};

use crate::json::{Node, write};
use crate::merge::{Line, Merged};
use crate::names::{metrics, sensor_name};
use crate::number::Number;
use crate::statistics::Global;
use crate::{Format, Plan, Refusal};

const RATIO_DIGITS: usize = 4;
/// Simulated frames per second.
const FRAMES: f64 = 20.0;

/// Files for EvalAI.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Files {
    /// The metrics: a list with one object, to be sent as text. All zero until the run is final.
    pub results_json: String,
    /// Results with the metrics over the routes done so far, for a leaderboard that shows partial results. `None` once the run
    /// is final, before the first route, and with [`Plan::as_original`].
    pub partial_json: Option<String>,
    /// The summary a participant reads.
    pub stdout_txt: String,
    /// The merged file; `None` when there is none.
    pub metadata_json: Option<String>,
}

/// Renders EvalAI's files; `None` when there is nothing merged yet.
pub fn render(plan: &Plan, merged: Option<&Merged>) -> Result<Files, Refusal> {
    let global = merged.and_then(|merged| merged.view.global.as_ref());
    let results_json = results(plan.format, global)?;
    let Some(merged) = merged else {
        return Ok(Files {
            results_json,
            partial_json: None,
            stdout_txt: NOTHING_YET.to_owned(),
            metadata_json: None,
        });
    };
    let so_far = merged.view.so_far.as_ref().filter(|_| !plan.as_original);
    Ok(Files {
        results_json,
        partial_json: so_far.map(|so_far| results(plan.format, Some(so_far))).transpose()?,
        stdout_txt: stdout(plan.format, merged)?,
        metadata_json: Some(merged.text.clone()),
    })
}

// "avaialable" is the original's, and the text is compared byte for byte.
const NOTHING_YET: &str = "Initializing the submission, no data avaialable yet.\n\
    More information will be found here once the submission starts running.\n";

fn results(format: Format, global: Option<&Global>) -> Result<String, Refusal> {
    let number = |metric| Node::Number(global.map_or(Number::ZERO, |global| global.metric(metric)));
    let accuracies = metrics(format)
        .iter()
        .map(|metric| (metric.name.as_bytes(), number(metric)))
        .collect();
    let split = Node::object([
        ("split", Node::Str("leaderboard")),
        ("show_to_participant", Node::Bool(true)),
        ("accuracies", Node::Object(accuracies)),
    ]);
    write(&Node::List(vec![split]), format.key_order()).map_err(|limit| Refusal::Output { limit })
}

fn stdout(format: Format, merged: &Merged) -> Result<String, Refusal> {
    let current = if merged.view.global.is_some() { "" } else { "current " };
    let mut out =
        format!("Here is a summary of the submission's {current}results\n\nGeneral information:\n- Sensors:\n");
    for (name, count) in sensors(merged)? {
        line(&mut out, format_args!("  - {count} {name}"));
    }
    let (done, total) = (merged.done, merged.total);
    if done == total {
        line(&mut out, format_args!("- All {total} route have been completed"));
    } else {
        line(&mut out, format_args!("- Completed {done} out of the {total} routes"));
    }
    let whole = whole_ratio(&merged.view.routes);
    line(&mut out, format_args!("- Submission ratio of {}x", whole.text()));
    line(&mut out, format_args!("- Submission FPS of {}", frames(whole).text()));
    if let Some(global) = &merged.view.global {
        out.push_str("- Results:\n");
        for metric in metrics(format) {
            line(
                &mut out,
                format_args!("  - {}: {}", metric.name, global.metric(metric).text()),
            );
        }
    }
    out.push('\n');
    if !merged.view.routes.is_empty() {
        out.push_str("Glossary of each route:\n");
    }
    for (index, route) in merged.view.routes.iter().enumerate() {
        glossary(&mut out, index, route);
    }
    Ok(out)
}

/// Writing to a String does not fail.
fn line(out: &mut String, text: fmt::Arguments<'_>) {
    let _ = out.write_fmt(text);
    out.push('\n');
}

fn glossary(out: &mut String, index: usize, route: &Line) {
    let ratio = ratio(route);
    line(out, format_args!("\n- Index: {index}"));
    line(out, format_args!("  - Route ID: {}", route.route_id));
    line(out, format_args!("  - Status: {}", route.status));
    line(out, format_args!("  - Ratio: {}x", ratio.rounded(RATIO_DIGITS).text()));
    line(out, format_args!("  - FPS: {}", frames(ratio).text()));
}

/// Each kind of sensor and how many, in the order of their first appearance.
fn sensors(merged: &Merged) -> Result<Vec<(&'static str, usize)>, Refusal> {
    let mut counted: Vec<(&str, usize)> = Vec::new();
    for (i, sensor) in merged.view.sensors.iter().enumerate() {
        let name = sensor.as_str().and_then(sensor_name).ok_or(Refusal::Sensor {
            pair: None,
            sensor: i.saturating_add(1),
        })?;
        match counted.iter_mut().find(|(known, _)| *known == name) {
            Some((_, count)) => *count = count.saturating_add(1),
            None => counted.push((name, 1)),
        }
    }
    Ok(counted)
}

/// Simulated seconds per real second; a whole 0 where nothing was measured.
fn ratio(route: &Line) -> Number {
    if route.system.is_zero() {
        Number::ZERO
    } else {
        Number::Float(route.game.as_f64() / route.system.as_f64())
    }
}

fn whole_ratio(routes: &[Line]) -> Number {
    let sum = |of: fn(&Line) -> Number| routes.iter().fold(Number::ZERO, |sum, route| sum.plus(of(route)));
    let (game, system) = (sum(|route| route.game), sum(|route| route.system));
    let exact = if system.is_zero() {
        0.0
    } else {
        game.as_f64() / system.as_f64()
    };
    Number::Float(exact).rounded(RATIO_DIGITS)
}

fn frames(ratio: Number) -> Number {
    match ratio {
        Number::Int(i) => Number::Int(i.saturating_mul(20)),
        Number::Float(f) => Number::Float(FRAMES * f).rounded(RATIO_DIGITS),
    }
}
