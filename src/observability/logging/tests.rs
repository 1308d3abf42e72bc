//! How a line of the log looks, and that no source dumps a data structure into one.

use super::*;
use leaderboard_base::spans as about;
use leaderboard_base::trace_id::TraceId;
use std::io::Write;
use std::sync::{Arc, Mutex};

use tracing::Dispatch;

/// The collected log, as the JSON lines of a program with the usual filter.
#[derive(Clone, Default)]
pub(crate) struct Lines(Arc<Mutex<Vec<u8>>>);

impl Lines {
    /// Takes what this thread logs until the guard is dropped.
    pub(crate) fn collect(&self) -> Collecting {
        let writer = self.clone();
        let subscriber = subscriber(Format::Json, None, move || writer.clone(), false).unwrap();
        Collecting {
            _second: Dispatch::new(tracing_subscriber::registry()),
            _guard: tracing::subscriber::set_default(subscriber),
        }
    }

    /// The text since the last call.
    pub(crate) fn take(&self) -> String {
        String::from_utf8(std::mem::take(&mut *self.0.lock().unwrap())).unwrap()
    }

    /// The lines since the last call, each parsed.
    pub(crate) fn take_json(&self) -> Vec<serde_json::Value> {
        let text = self.take();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }
}

/// Guard of the collection. With a single subscriber in the process, a line that another test's thread reaches first is off for good.
pub(crate) struct Collecting {
    _guard: tracing::subscriber::DefaultGuard,
    _second: Dispatch,
}

impl Write for Lines {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

fn logged(format: Format, filter: Option<&str>, is_terminal: bool) -> String {
    let lines = Lines::default();
    let writer = lines.clone();
    let subscriber = subscriber(format, filter, move || writer.clone(), is_terminal).unwrap();
    tracing::subscriber::with_default(subscriber, || {
        let _span = tracing::info_span!("reconcile", submission = "submission-7").entered();
        tracing::info!(attempt = 2, "started");
        tracing::debug!("a detail");
    });
    lines.take()
}

#[test]
fn json_lines_hold_the_fields_and_the_spans_and_no_escapes() {
    for is_terminal in [true, false] {
        let text = logged(Format::Json, None, is_terminal);
        let line: serde_json::Value = serde_json::from_str(text.trim_end()).unwrap();
        assert_eq!(
            (&line["message"], &line["attempt"], &line["level"]),
            (&"started".into(), &2.into(), &"INFO".into())
        );
        assert_eq!(
            (&line["submission"], line.get("spans")),
            (&"submission-7".into(), None),
            "a span's fields stand in the line"
        );
        assert!(!text.contains('\u{1b}'), "{text}");
    }
}

#[test]
fn the_event_wins_over_its_span_and_spans_of_libraries_are_apart() {
    let lines = Lines::default();
    let _guard = lines.collect();
    let _ours = tracing::error_span!("submission", attempt = 1).entered();
    let _other = tracing::error_span!(target: "hyper::client", "connect", level = "odd").entered();
    tracing::info!(attempt = 2, took = 0.5, is_last = true, "started");
    let found = lines.take_json();
    let fields = ["attempt", "took", "is_last", "level", "target"].map(|name| &found[0][name]);
    let target = "leaderboard_operator::observability::logging::tests";
    assert_eq!(
        serde_json::json!(fields),
        serde_json::json!([2, 0.5, true, "INFO", target])
    );
    assert_eq!(
        found[0]["spans"],
        serde_json::json!([{"name": "connect", "level": "odd"}])
    );
}

#[test]
fn auto_is_json_unless_a_person_reads_and_colors_are_for_terminals() {
    assert!(logged(Format::Auto, None, false).starts_with('{'));
    let text = logged(Format::Auto, None, true);
    assert!(
        !text.starts_with('{') && text.contains('\u{1b}') && text.contains("submission-7"),
        "{text}"
    );
    assert!(!logged(Format::Text, None, false).contains('\u{1b}'));
}

#[test]
fn the_filter_rules_and_an_unreadable_one_is_refused() {
    assert_eq!(logged(Format::Json, Some("debug"), false).lines().count(), 2);
    assert_eq!(logged(Format::Json, Some("warn"), false), "");
    assert_eq!(logged(Format::Json, Some(" "), false).lines().count(), 1);
    let error = subscriber(Format::Json, Some("info,=="), std::io::sink, false)
        .err()
        .unwrap();
    assert!(error.to_string().contains("info,=="), "{error}");
}
/// The text inside the parentheses of each `tracing` macro of a source.
fn macros(source: &str) -> Vec<&str> {
    let starts = ["trace", "debug", "info", "warn", "error"].map(|level| format!("tracing::{level}!("));
    let begins = starts.iter().flat_map(|start| {
        let found = source.match_indices(start.as_str());
        found.map(|(at, _)| &source[at + start.len()..]).collect::<Vec<_>>()
    });
    begins.map(|rest| &rest[..length(rest)]).collect()
}

/// Up to the parenthesis that ends it; parentheses in texts do not count.
fn length(rest: &str) -> usize {
    let (mut depth, mut in_text, mut escaped) = (1, false, false);
    for (at, byte) in rest.bytes().enumerate() {
        match byte {
            _ if escaped => escaped = false,
            b'\\' if in_text => escaped = true,
            b'"' => in_text = !in_text,
            b'(' if !in_text => depth += 1,
            b')' if !in_text => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return at;
        }
    }
    rest.len()
}

/// A dump of a data structure: `?field`, `field = ?value`, `{value:?}`.
fn has_dump(call: &str) -> bool {
    let before = |at: usize| call[..at].trim_end().bytes().last();
    let after = |at: usize| call[at + 1..].bytes().next();
    let sigil = |at: usize| {
        matches!(before(at), None | Some(b',' | b'='))
            && after(at).is_some_and(|byte| byte.is_ascii_alphabetic() || byte == b'_')
    };
    call.contains(":?}") || call.contains(":#?}") || call.match_indices('?').any(|(at, _)| sigil(at))
}

fn sources(folder: &std::path::Path, found: &mut Vec<std::path::PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

#[test]
fn dumps_in_log_lines_are_recognized() {
    for dump in ["?outcome, \"x\"", "a = ?b", "\"{why:?}\"", "a,\n    ?b"] {
        assert!(has_dump(dump), "{dump}");
    }
    for fine in ["%error, \"why?\"", "a = b.c()?, \"x\"", "\"{error}\""] {
        assert!(!has_dump(fine), "{fine}");
    }
    // In pieces, since this source is searched too.
    let source = r#"tracing:: info!(a = f(b), "smile ;)"); tracing:: warn!("{c:?}");"#.replace(":: ", "::");
    assert_eq!(macros(&source), [r#"a = f(b), "smile ;)""#, r#""{c:?}""#]);
}

#[test]
fn no_log_line_dumps_a_data_structure() {
    let mut found = Vec::new();
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    for folder in ["src", "crates"] {
        sources(&root.join(folder), &mut found);
    }
    let mut dumps = Vec::new();
    for path in found {
        let text = std::fs::read_to_string(&path).unwrap();
        let calls = macros(&text);
        dumps.extend(
            calls
                .into_iter()
                .filter(|call| has_dump(call))
                .map(|call| format!("{}: {call}", path.display())),
        );
    }
    assert!(dumps.is_empty(), "write it with % or as a text:\n{}", dumps.join("\n"));
}

#[test]
fn work_of_another_task_logs_with_the_fields_of_who_asked_for_it() {
    let lines = Lines::default();
    let _guard = lines.collect();
    let log = about::LogSpan::of("ns/one", "carla", 2, "uid");
    tracing::warn!("nothing is known");
    log.span().in_scope(|| tracing::warn!(why = "slow", "late"));
    let found = lines.take_json();
    assert_eq!(found.len(), 2);
    assert_eq!(found[0].get("submission"), None);
    let fields = ["submission", "leaderboard", "attempt", "trace_id", "why", "message"].map(|name| &found[1][name]);
    let trace = TraceId::of("uid").to_string();
    let expected = serde_json::json!(["ns/one", "carla", 2, trace, "slow", "late"]);
    assert_eq!(serde_json::json!(fields), expected);
}

#[test]
fn what_comes_in_is_identified_once_its_object_is_known() {
    let lines = Lines::default();
    let _guard = lines.collect();
    about::incoming("ns/one", "carla").in_scope(|| {
        tracing::info!("before");
        about::identify(3, "uid");
        tracing::info!("after");
    });
    let found = lines.take_json();
    assert_eq!((found[0].get("attempt"), found[0].get("trace_id")), (None, None));
    assert_eq!(found[0]["submission"], "ns/one");
    assert_eq!(
        (&found[1]["attempt"], &found[1]["submission"]),
        (&3.into(), &"ns/one".into())
    );
    assert_eq!(found[1]["trace_id"], TraceId::of("uid").to_string());
}
