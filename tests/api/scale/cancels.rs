//! Cancels in EvalAI while many submissions run: how long each takes to reach its Pod, and whether any is undone.

use kube::api::{Patch, PatchParams};

use super::*;

#[tokio::test(flavor = "multi_thread")]
#[ignore = "it measures for ten minutes: make measure-scale"]
async fn a_hundred_cancels_while_three_hundred_run() {
    // They start at a faster pace than they run.
    let size = Size {
        requests_per_minute: 600,
        ..FULL
    };
    let mut world = World::start(&size).await;
    let pks = world.run(&size).await;
    world.slow_down(FULL.requests_per_minute).await;
    let cancelled = &pks[..size.cancels];
    let (undone, mut waits) = world.cancel_all(&size, cancelled).await;
    waits.sort_by(f64::total_cmp);
    let middle = waits.get(cancelled.len() / 2).copied();
    assert_eq!((undone.len(), waits.len()), (0, cancelled.len()));
    assert!(middle <= Some(15.0), "half of them after {middle:?} s");
    world
        .until(&size, "the cancelled have ended", |seen| {
            cancelled.iter().all(|pk| seen.is(&name(*pk), State::Cancelled))
        })
        .await;
    world.check_cancelled(cancelled.iter(), &world.evalai.requests());
    world.operator.end().await;
}

impl World {
    /// From now on so many requests a minute are allowed; waits until the minute before is over.
    async fn slow_down(&self, requests_per_minute: usize) {
        let boards: Api<Leaderboard> = Api::namespaced(self.client.clone(), &self.namespace);
        let slower = json!({"spec": {"evalai": {"requestsPerMinute": requests_per_minute}}});
        boards
            .patch(BOARD, &PatchParams::default(), &Patch::Merge(slower))
            .await
            .unwrap();
        tokio::time::sleep(Duration::from_secs(75)).await;
    }

    /// Cancels these, and waits until each is stopped. Gives those whose cancel a write of ours has undone, and how long each stop took.
    pub(super) async fn cancel_all(&mut self, size: &Size, pks: &[u64]) -> (Vec<u64>, Vec<f64>) {
        let times = self.cancel(pks, size.cancel_over).await;
        let undone = self.settle(size, pks).await;
        let stopped = self.player.seen().asked_to_stop;
        let waits = pks
            .iter()
            .filter_map(|pk| Some(between(times[pk], *stopped.get(&name(*pk))?)));
        let waits: Vec<f64> = waits.collect();
        say("cancelled in EvalAI to the stop on the Pod", waits.clone());
        println!(
            "{} of {} cancels were undone by a write of ours",
            undone.len(),
            pks.len()
        );
        self.explain(&undone, &times);
        (undone, waits)
    }
}
