//! Lets the operator take one submission in, so that [`crate::raw`] has its bodies.

use std::time::Duration;

use tokio::time::{Instant, sleep};

use crate::audit;
use crate::bench::{Bench, Outcome};
use crate::names::SAMPLE;
use crate::raw::{Bodies, create_submission};
use crate::servers::Audit;
use crate::world::{Setup, World};

const LIMIT: Duration = Duration::from_mins(1);

/// The bodies that the operator writes for one submission.
pub async fn take(bench: &Bench) -> Outcome<Bodies> {
    let setup = Setup {
        audit: Audit::Bodies,
        has_operator: true,
        ..Setup::default()
    };
    let world = World::start(bench, &setup).await?;
    let uid = create_submission(&world.client, SAMPLE).await?.uid;
    if !world
        .observed
        .until(LIMIT, |moments| moments.jobs.contains_key(SAMPLE))
        .await
    {
        return Err("the operator makes no Job of a submission".into());
    }
    let end = Instant::now() + LIMIT;
    loop {
        // A line is written after the answer.
        let entries = audit::read(&world.servers.audit_log())?;
        if let Some(bodies) = Bodies::of_sample(&entries, &uid) {
            return Ok(bodies);
        }
        if Instant::now() > end {
            return Err("the audit log has no body of a status and of a Job".into());
        }
        sleep(Duration::from_millis(100)).await;
    }
}
