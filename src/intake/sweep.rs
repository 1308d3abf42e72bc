//! Submissions whose message was lost: each row that EvalAI's lists show becomes a Submission of the Leaderboard that serves it.
//!
//! Started by the controller's leader. `ingest` decides on the step that a row needs for the object of its name.

use std::sync::Arc;

use kube::{Api, Client, ResourceExt};
use tokio::sync::mpsc;
use tracing::Instrument;

use crate::intake::ingest::{self, Incoming, Source};
use crate::kubernetes::Store;
use leaderboard_api::{Evalai, EvalaiRef, Foreign, Leaderboard, Submission};
use leaderboard_evalai::{SweepRow, Swept};
use leaderboard_policy::intake::route::{self, Outcome};

/// Takes rows in until their sender is gone.
pub async fn into_cluster(
    client: Client,
    leaderboards: Store<Leaderboard>,
    mut rows: mpsc::UnboundedReceiver<SweepRow>,
) {
    while let Some(row) = rows.recv().await {
        let all = leaderboards.state();
        let Some(board) = serving(&all, &row) else { continue };
        let namespace = board.namespace().unwrap_or_default();
        let span = ingest::span(&namespace, &board.name_any(), row.submission);
        take(&client, board, &row, kind(&all, &row)).instrument(span).await;
    }
}

async fn take(client: &Client, board: &Leaderboard, row: &SweepRow, kind: Swept) {
    let server = &row.server;
    if let Some(why) = route::misfit(row.is_static_code_upload, board) {
        tracing::warn!(server, why, "EvalAI waits for a run of a submission, and none begins");
        return;
    }
    let namespace = board.namespace().unwrap_or_default();
    let api: Api<Submission> = Api::namespaced(client.clone(), &namespace);
    let incoming = Incoming {
        evalai: EvalaiRef {
            challenge: row.challenge,
            phase: row.phase,
            submission: row.submission,
        },
        image: None,
        source: Source::Sweep(kind),
        sent_ms: row.time.as_millisecond(),
    };
    match ingest::apply(&api, &board.name_any(), &incoming).await {
        Ok(Outcome::Repeat) => tracing::debug!(server, "the submission is known already"),
        Ok(outcome @ (Outcome::Refused | Outcome::NotNew | Outcome::IdTaken(_))) => {
            tracing::warn!(server, %outcome, "EvalAI waits for a run of a submission, and none begins");
        }
        Ok(outcome) => {
            tracing::info!(server, %outcome, "EvalAI waits for a submission whose message was lost");
        }
        Err(error) => {
            tracing::warn!(server, %error, "EvalAI waits for a submission that could not be created or resumed");
        }
    }
}

/// The oldest Leaderboard of the row's server that serves its phase: the same one that the bridge and `Ready` name.
fn serving<'a>(all: &'a [Arc<Leaderboard>], row: &SweepRow) -> Option<&'a Arc<Leaderboard>> {
    all.iter().filter(|l| serves(l, row)).min_by_key(|l| l.seniority())
}

fn serves(board: &Leaderboard, row: &SweepRow) -> bool {
    let is_of_server = board.spec.evalai.as_ref().map(Evalai::server).as_ref() == Some(&row.server);
    is_of_server && board.serves(row.challenge, row.phase) && board.metadata.deletion_timestamp.is_none()
}

/// How a row counts. Another reader of the phase's queue may hold the message of any row, so then a row makes no object.
fn kind(all: &[Arc<Leaderboard>], row: &SweepRow) -> Swept {
    let leaves = |board: &Leaderboard| board.spec.sqs().is_some_and(|q| q.foreign == Foreign::Leave);
    let is_shared = all.iter().any(|board| serves(board, row) && leaves(board));
    match row.kind {
        Swept::New | Swept::Rerun if is_shared => Swept::Edited,
        kind => kind,
    }
}

#[cfg(test)]
mod tests {
    use http::{Request, Response};
    use jiff::Timestamp;
    use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
    use kube::client::Body;
    use serde_json::{Value, json};

    use super::*;

    /// A Leaderboard of challenge 1 with phase 2, created at this second, in a namespace of its own name.
    fn board(name: &str, second: i64, server: &str) -> Leaderboard {
        let spec = json!({
            "evalai": {"apiServer": server, "challenge": 1, "token": {"secretKeyRef": {"name": "t", "key": "k"}}},
            "tracks": [{"name": "sensors", "phase": 2}],
            "evaluation": {"carla": {
                "version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
            }}, "storage": {"s3": {"bucket": "bbb"}},
        });
        let mut board = Leaderboard::new(name, serde_json::from_value(spec).unwrap());
        board.metadata.namespace = Some(name.into());
        board.metadata.creation_timestamp = Some(Time(Timestamp::from_second(second).unwrap()));
        board
    }

    fn row(server: &str, phase: i64) -> SweepRow {
        SweepRow {
            server: server.into(),
            challenge: 1,
            phase,
            submission: 7,
            kind: Swept::New,
            is_static_code_upload: false,
            time: Timestamp::from_second(100).unwrap(),
        }
    }

    #[test]
    fn a_row_belongs_to_the_oldest_leaderboard_of_its_own_server() {
        let mut going = board("going", 0, "https://staging");
        going.metadata.deletion_timestamp = Some(Time(Timestamp::from_second(50).unwrap()));
        let all = [
            going,
            board("old", 1, "https://eval.ai/"),
            board("staging", 2, "https://Staging"),
            board("younger", 3, "https://staging/"),
        ];
        let all: Vec<_> = all.into_iter().map(Arc::new).collect();
        for (row, wanted) in [
            (row("https://eval.ai", 2), Some("old")),
            (row("https://staging", 2), Some("staging")),
            (row("https://staging", 3), None),
            (row("https://other", 2), None),
        ] {
            let found = serving(&all, &row).map(|l| l.name_any());
            assert_eq!(found.as_deref(), wanted, "{row:?}");
        }
    }

    #[test]
    fn where_a_queue_of_the_phase_is_shared_on_purpose_a_row_makes_nothing_new() {
        let with_queue = |name: &str, foreign: &str| {
            let mut board = board(name, 1, "https://eval.ai");
            board.spec.queue =
                serde_json::from_value(json!({"sqs": {"url": "https://q", "foreign": foreign}})).unwrap();
            Arc::new(board)
        };
        let without = || Arc::new(board("c", 1, "https://eval.ai"));
        let of = |kind| SweepRow {
            kind,
            ..row("https://eval.ai", 2)
        };
        let alone = [with_queue("a", "DeadLetter"), without()];
        let shared = [with_queue("a", "Leave"), without()];
        for (swept, among_shared) in [
            (Swept::New, Swept::Edited),
            (Swept::Rerun, Swept::Edited),
            (Swept::Resuming, Swept::Resuming),
            (Swept::Edited, Swept::Edited),
        ] {
            assert_eq!(kind(&alone, &of(swept)), swept);
            assert_eq!(kind(&shared, &of(swept)), among_shared);
        }
        // Another phase's queue, and another server's, are not this row's.
        assert_eq!(kind(&shared, &row("https://eval.ai", 3)), Swept::New);
        assert_eq!(kind(&shared, &row("https://staging", 2)), Swept::New);
    }

    /// Answers with what was sent, and hands back each path.
    fn cluster() -> (Client, mpsc::UnboundedReceiver<(String, Value)>) {
        let (service, mut handle) = tower_test::mock::pair::<Request<Body>, Response<Body>>();
        let (sender, asked) = mpsc::unbounded_channel();
        tokio::spawn(async move {
            while let Some((request, answer)) = handle.next_request().await {
                let line = format!("{} {}", request.method(), request.uri().path());
                let body = request.into_body().collect_bytes().await.unwrap();
                let _ = sender.send((line, serde_json::from_slice(&body).unwrap_or_default()));
                answer.send_response(Response::new(Body::from(body.to_vec())));
            }
        });
        (Client::new(service, "default"), asked)
    }

    #[tokio::test]
    async fn what_another_reader_may_have_is_not_made() {
        let mut shared = board("real", 1, "http://one");
        shared.spec.queue = serde_json::from_value(json!({"sqs": {"url": "https://q", "foreign": "Leave"}})).unwrap();
        let (client, mut asked) = cluster();
        let (sender, rows) = mpsc::unbounded_channel();
        sender.send(row("http://one", 2)).unwrap();
        sender.send(row("http://two", 2)).unwrap();
        drop(sender);
        into_cluster(
            client,
            Store::of([shared, board("quiet", 1, "http://two")], |_| None),
            rows,
        )
        .await;
        let mut made = std::iter::from_fn(|| asked.try_recv().ok()).filter(|(line, _)| line.starts_with("POST"));
        let (line, _) = made.next().unwrap();
        assert!(line.ends_with("/namespaces/quiet/submissions"), "{line}");
        assert!(made.next().is_none());
    }

    #[tokio::test]
    async fn a_static_code_upload_is_made_in_the_mode_batch_alone() {
        let in_mode = |mode: &str| {
            let mut board = board(&mode.to_lowercase(), 1, &format!("http://{mode}"));
            let evaluation = json!({"container": {"mode": mode, "image": "e", "command": ["e"]}});
            board.spec.evaluation = serde_json::from_value(evaluation).unwrap();
            board
        };
        let carla = board("carla", 1, "http://Carla");
        let boards = [in_mode("Batch"), in_mode("Interactive"), in_mode("Predictions"), carla];
        let (client, mut asked) = cluster();
        let (sender, rows) = mpsc::unbounded_channel();
        let rows_of = |is_static_code_upload| {
            boards.iter().map(move |board| SweepRow {
                is_static_code_upload,
                ..row(&board.spec.evalai.as_ref().unwrap().server(), 2)
            })
        };
        for row in rows_of(true).chain(rows_of(false)) {
            sender.send(row).unwrap();
        }
        drop(sender);
        into_cluster(client, Store::of(boards, |_| None), rows).await;
        let made =
            std::iter::from_fn(|| asked.try_recv().ok()).map(|(_, object)| object["spec"]["leaderboardName"].clone());
        assert_eq!(
            made.collect::<Vec<_>>(),
            ["batch", "batch", "interactive", "predictions", "carla"]
        );
    }

    #[tokio::test]
    async fn two_servers_with_the_same_ids_are_kept_apart() {
        let boards = [board("stand-in", 1, "http://one"), board("real", 2, "http://two")];
        let (client, mut asked) = cluster();
        let (sender, rows) = mpsc::unbounded_channel();
        for server in ["http://two", "http://one"] {
            sender.send(row(server, 2)).unwrap();
        }
        drop(sender);
        into_cluster(client, Store::of(boards, |_| None), rows).await;
        for name in ["real", "stand-in"] {
            let (line, object) = asked.recv().await.unwrap();
            let path = "/apis/leaderboard.carla.org/v1alpha1/namespaces";
            assert_eq!(line, format!("POST {path}/{name}/submissions"));
            assert_eq!(object["spec"]["leaderboardName"], name);
        }
    }
}
