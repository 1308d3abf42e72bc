//! Each end in each state that EvalAI may have, and the result.

use super::*;

/// A submission of each state that EvalAI knows, for this end: its id, and what is read of it.
fn in_each_state(world: &World, wanted: Outcome, missing: i64) -> Vec<(i64, Status, Outcome)> {
    let submitted = |status| {
        let pk = world.submit();
        world.set(pk, status);
        pk
    };
    let of = |status: Stored| (submitted(status), Status::parse(status.as_str()), wanted);
    let mut all: Vec<_> = Stored::ALL.into_iter().map(of).collect();
    for (status, read) in [
        (Stored::PartiallyEvaluated, Status::Deleted),
        (Stored::Finished, Status::Ignored),
    ] {
        let pk = submitted(status);
        world.delete(pk);
        all.push((pk, read, wanted));
    }
    all.push((missing, Status::Missing, wanted));
    all
}

/// The result of an end that EvalAI's state leaves no room for.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Kept {
    Agreed(Status),
    Otherwise(Status),
}

impl Kept {
    pub(super) fn of(end: &Ended) -> Option<Self> {
        match end {
            Ended::Agreed { status, .. } => Some(Self::Agreed(*status)),
            Ended::Otherwise(status) => Some(Self::Otherwise(*status)),
            Ended::Published { .. } | Ended::Refused(_) => None,
        }
    }
}

/// None: it is published.
fn refused(status: Status, wanted: Outcome) -> Option<Kept> {
    use Outcome::{Cancelled, Failed, Finished};
    let is_gone = matches!(
        status,
        Status::Cancelled | Status::Archived | Status::Ignored | Status::Missing
    );
    match (status, wanted) {
        (Status::Deleted, Finished | Failed) => Some(Kept::Otherwise(status)),
        (Status::Failed, Failed | Cancelled) | (Status::Finished, Cancelled) => Some(Kept::Agreed(status)),
        _ if is_gone && wanted == Cancelled => Some(Kept::Agreed(status)),
        _ if is_gone => Some(Kept::Otherwise(status)),
        _ => None,
    }
}

#[tokio::test]
async fn each_end_is_published_as_its_table_shows() {
    let mut world = World::new().await;
    let wanted = [Outcome::Finished, Outcome::Failed, Outcome::Cancelled].into_iter();
    let cases: Vec<_> = wanted
        .zip(90_000..)
        .flat_map(|(wanted, missing)| in_each_state(&world, wanted, missing))
        .collect();
    for (pk, _, wanted) in &cases {
        world.update(*pk, DesiredUpdate::Final(*wanted, results(&world.target, 43.0)));
    }
    for (pk, status, wanted) in cases {
        let end = world.ended(pk).await;
        let Some(expected) = refused(status, wanted) else {
            let is_published = matches!(end, Ended::Published { outcome, .. } if outcome == wanted);
            assert!(is_published, "{status} {wanted:?}: {end:?}");
            assert_eq!(world.stored(pk).as_str(), wanted.as_str(), "{status} {wanted:?}");
            continue;
        };
        assert_eq!(Kept::of(&end), Some(expected), "{status} {wanted:?}");
        if status == Status::Deleted {
            assert_eq!(
                world.stored(pk),
                Stored::Cancelled,
                "it counts as being processed no more"
            );
            continue;
        }
        let puts = world.sent("PUT").into_iter();
        let puts = puts.filter(|entry| entry.body["submission"] == json!(pk)).count();
        assert_eq!(puts, 0, "{status} {wanted:?}");
    }
}
