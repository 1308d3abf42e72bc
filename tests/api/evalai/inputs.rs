//! Files that are submissions: how the stand-in gives them out, and what is read of them.

use futures::TryStreamExt;
use leaderboard_evalai::{InputAddress, InputError};

use super::*;

const CONTENT: &[u8] = b"id,label\n1,cat\n2,dog\n";

impl World {
    /// Submits a file whose address is known then.
    async fn submit_predictions(&mut self) -> (i64, InputAddress) {
        let pk = self.submit_file(CONTENT.to_vec(), FileState::Stored, Timestamp::now());
        self.ask(pk, false);
        self.until(pk, |view| view.row.is_some()).await;
        (pk, self.hub.input_address(&key(pk)).unwrap())
    }

    fn file_is(&self, pk: i64, state: FileState) {
        let pk = u64::try_from(pk).unwrap();
        self.server
            .with_state(|rows| rows.submissions.get_mut(&pk).unwrap().file_state = state);
    }

    async fn content(&self, address: &InputAddress) -> Result<Vec<u8>, InputError> {
        let chunks: Vec<_> = self.hub.open_input(address).await?.try_collect().await?;
        Ok(chunks.concat())
    }
}

#[tokio::test]
async fn a_file_is_read_as_it_was_uploaded_or_an_error_says_why_not() {
    let mut world = World::new().await;
    let (pk, address) = world.submit_predictions().await;
    assert_eq!(world.content(&address).await, Ok(CONTENT.to_vec()));
    for (state, expected) in [
        (FileState::Missing, InputError::Gone(404)),
        (FileState::Gone, InputError::Gone(410)),
    ] {
        world.file_is(pk, state);
        assert_eq!(world.content(&address).await, Err(expected));
    }
    for (state, part) in [
        (FileState::Unreachable, "broke off"),
        (FileState::Cut, "broke off"),
        (FileState::Silent, "did not answer in time"),
    ] {
        world.file_is(pk, state);
        let Err(InputError::Silent(why)) = world.content(&address).await else {
            panic!("{state:?} is a file")
        };
        assert!(why.contains(part) && !why.contains("/media/"), "{state:?}: {why}");
    }
    world.file_is(pk, FileState::Stored);
    assert_eq!(world.content(&address).await, Ok(CONTENT.to_vec()));
    let mut sent = world.sent("GET");
    sent.retain(|entry| entry.path.contains("/media/"));
    let has_token = sent.iter().any(|entry| entry.token.is_some());
    assert!(sent.len() >= 7 && !has_token, "{sent:?}");
}

#[tokio::test]
async fn a_file_of_any_size_comes_in_chunks_and_its_reader_may_stop() {
    let mut world = World::new().await;
    let (pk, address) = world.submit_predictions().await;
    world.file_is(pk, FileState::Zeros(10 << 30));
    let mut chunks = world.hub.open_input(&address).await.unwrap();
    let mut read = 0;
    while read < 8 << 20 {
        let chunk = chunks.try_next().await.unwrap().unwrap();
        assert!(chunk.len() <= 1 << 20, "{} bytes at once", chunk.len());
        read += chunk.len();
    }
    drop(chunks);
    world.file_is(pk, FileState::Stored);
    assert_eq!(world.content(&address).await, Ok(CONTENT.to_vec()));
}

#[tokio::test]
async fn an_address_that_has_expired_gives_way_to_the_one_of_the_row_now() {
    let mut world = World::new().await;
    let (pk, old) = world.submit_predictions().await;
    world.live(pk);
    let before = world.hub.view(&key(pk)).unwrap().row;
    world.server.with_state(evalai_stand_in::State::expire_addresses);
    assert_eq!(world.content(&old).await, Err(InputError::Gone(403)));
    world.until(pk, |view| view.row != before).await;
    let new = world.hub.input_address(&key(pk)).unwrap();
    assert_eq!(world.content(&new).await, Ok(CONTENT.to_vec()));
    let shown = format!("{new:?} {:?}", world.hub.view(&key(pk)));
    assert!(!shown.contains("signature") && !shown.contains("/media/"), "{shown}");
}

#[tokio::test]
async fn a_challenge_that_evalais_own_worker_evaluates_is_named() {
    let mut world = World::new().await;
    world
        .server
        .with_state(|state| state.seed.challenges[0].remote_evaluation = false);
    world.target.takes_files = true;
    world.hub.serve(&leaderboard(), &world.target).unwrap();
    let labels = loop {
        if let Some(labels) = world.hub.labels(&leaderboard()).0 {
            break labels;
        }
        world.changed.recv().await.unwrap();
    };
    assert!(
        labels.ok() && labels.problems == [Misfit::NotRemote { challenge: 1 }],
        "{labels:?}"
    );
}
