//! The process's one stop signal: SIGTERM or SIGINT, for every part.
//!
//! Made once by `main`, cloned to all parts. Each part decides how it stops.

use std::io;

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::watch;

/// Exit code after a second Ctrl-C, as shells know it.
const INTERRUPTED: i32 = 130;

/// Becomes true once and stays so.
#[derive(Clone, Debug)]
pub struct Stop(watch::Receiver<bool>);

impl Stop {
    /// A stop that is signaled by sending `true`. A sender that is dropped has signaled, too.
    pub fn new() -> (watch::Sender<bool>, Self) {
        let (sender, receiver) = watch::channel(false);
        (sender, Self(receiver))
    }

    /// True once the process has to end.
    pub fn is_set(&self) -> bool {
        *self.0.borrow() || self.0.has_changed().is_err()
    }

    /// Returns when the process has to end. Safe to drop and to call again.
    pub async fn wait(&self) {
        let mut receiver = self.0.clone();
        // An error means that the sender is gone, hence that no more work is wanted.
        let _ = receiver.wait_for(|stop| *stop).await;
    }
}

/// Listens for SIGTERM and SIGINT. Ctrl-C a second time ends the process without any more ado.
///
/// # Errors
/// If the process may not have signal handlers.
pub fn on_signals() -> io::Result<Stop> {
    let (sender, stop) = Stop::new();
    let (terminate, interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    tokio::spawn(listen(sender, terminate, interrupt));
    Ok(stop)
}

async fn listen(sender: watch::Sender<bool>, mut terminate: Signal, mut interrupt: Signal) {
    let name = tokio::select! {
        biased;
        _ = terminate.recv() => "SIGTERM",
        _ = interrupt.recv() => "SIGINT",
    };
    tracing::info!(signal = name, "stopping; a second Ctrl-C ends the process at once");
    // Without a receiver no part is left.
    let _ = sender.send(true);
    interrupt.recv().await;
    std::process::exit(INTERRUPTED);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn every_clone_sees_the_stop_also_one_that_asks_late() {
        let (sender, stop) = Stop::new();
        let early = tokio::spawn({
            let stop = stop.clone();
            async move { stop.wait().await }
        });
        assert!(!stop.is_set());
        sender.send(true).unwrap();
        early.await.unwrap();
        stop.wait().await;
        assert!(stop.is_set());
    }

    #[tokio::test]
    async fn a_vanished_sender_is_a_stop() {
        let (sender, stop) = Stop::new();
        drop(sender);
        stop.wait().await;
        assert!(stop.is_set());
    }

    #[tokio::test]
    async fn sigterm_sets_it() {
        let stop = on_signals().unwrap();
        nix::sys::signal::raise(nix::sys::signal::Signal::SIGTERM).unwrap();
        stop.wait().await;
        assert!(stop.is_set());
    }
}
