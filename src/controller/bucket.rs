//! The way of passes to buckets: each call with a limit of time, and none to a bucket that is known to hang.
//!
//! Passes are bounded in number, so that one bucket which never answers would keep them all, and with them every other
//! submission, waiting. Called by whatever a pass reads or writes in S3; what the answers mean is for its callers. The
//! Leaderboards' own look at their buckets (`leaderboards`) goes its own way: it has passes of its own.

mod breaker;

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures::FutureExt;
use tokio::time::Instant;

use crate::services::archive::ArchiveError;
use breaker::{Breaker, Change, Permit};
use leaderboard_api::Storage;

/// A failure without an answer that took so long is a silence, too: the client gives up by itself once its connections have not
/// come about.
const HANGS: Duration = Duration::from_secs(4);

/// Why a bucket gave nothing.
#[derive(thiserror::Error, Debug)]
pub enum BucketError {
    /// It has not answered, or was not asked since it does not answer. Both say the same, so that a status does not change with it.
    #[error("the bucket {0} did not answer in time")]
    Silent(String),
    /// It has answered, or nothing was asked at all.
    #[error(transparent)]
    Refused(#[from] ArchiveError),
}

/// What is known of buckets that hang.
#[derive(Default)]
pub struct Buckets(Mutex<HashMap<String, Breaker>>);

/// What tells a bucket from another one.
pub fn id(storage: &Storage) -> String {
    format!("{:?}/{:?}/{}", storage.region, storage.endpoint, storage.bucket)
}

impl Buckets {
    /// Makes a call, unless its bucket is known to hang.
    pub fn call<'a, T: 'a>(
        &'a self,
        storage: &'a Storage,
        limit: Duration,
        call: impl Future<Output = Result<T, ArchiveError>> + Send + 'a,
    ) -> impl Future<Output = Result<T, BucketError>> {
        // A request of the SDK is large, and would be held twice by every pass.
        let call = call.boxed();
        async move {
            let silent = || BucketError::Silent(storage.bucket.clone());
            let mut under_way = UnderWay::begin(self, storage).ok_or_else(silent)?;
            let began = Instant::now();
            let result = tokio::time::timeout(limit, call).await;
            let is_silent = match &result {
                Ok(Ok(_)) => false,
                Ok(Err(error)) => error.cause.is_transient() && began.elapsed() >= HANGS,
                Err(_) => true,
            };
            under_way.end(is_silent);
            Ok(result.map_err(|_| silent())??)
        }
    }

    /// The same for what may be large, and so slow, or has little time: not made either while its bucket is known to hang, but its
    /// own silence says nothing of the bucket.
    pub fn call_large<'a, T: 'a>(
        &'a self,
        storage: &'a Storage,
        limit: Duration,
        call: impl Future<Output = Result<T, ArchiveError>> + Send + 'a,
    ) -> impl Future<Output = Result<T, BucketError>> {
        let call = call.boxed();
        async move {
            let silent = || BucketError::Silent(storage.bucket.clone());
            if self.lock().get(&id(storage)).is_some_and(Breaker::is_open) {
                return Err(silent());
            }
            Ok(tokio::time::timeout(limit, call).await.map_err(|_| silent())??)
        }
    }

    fn ask(&self, id: &str) -> Option<Permit> {
        let now = Instant::now();
        match self.lock().get_mut(id) {
            Some(breaker) => breaker.ask(now),
            None => Some(Permit::free(now)),
        }
    }

    fn answered(&self, id: &str) -> Option<Change> {
        self.lock().get_mut(id)?.answered(Instant::now())
    }

    fn silent(&self, id: &str, permit: Permit) -> Option<Change> {
        let now = Instant::now();
        let mut known = self.lock();
        known.retain(|known, breaker| known == id || breaker.is_of_use(now));
        let breaker = known.entry(id.to_owned()).or_insert_with(|| Breaker::new(now));
        breaker.silent(permit, now)
    }

    fn given_up(&self, id: &str, permit: Permit) {
        if let Some(breaker) = self.lock().get_mut(id) {
            breaker.given_up(permit, Instant::now());
        }
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<String, Breaker>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A call that has not ended. A pass that runs out of time drops it.
struct UnderWay<'a> {
    buckets: &'a Buckets,
    storage: &'a Storage,
    id: String,
    permit: Option<Permit>,
}

impl<'a> UnderWay<'a> {
    fn begin(buckets: &'a Buckets, storage: &'a Storage) -> Option<Self> {
        let id = id(storage);
        let permit = Some(buckets.ask(&id)?);
        Some(Self {
            buckets,
            storage,
            id,
            permit,
        })
    }

    fn end(&mut self, is_silent: bool) {
        let Some(permit) = self.permit.take() else { return };
        let change = if is_silent {
            self.buckets.silent(&self.id, permit)
        } else {
            self.buckets.answered(&self.id)
        };
        let (bucket, endpoint) = (&self.storage.bucket, self.storage.endpoint.as_deref());
        match change {
            Some(Change::Opened) => tracing::warn!(
                bucket,
                endpoint,
                "the bucket does not answer; passes go on without it until it does"
            ),
            Some(Change::Closed) => tracing::info!(bucket, endpoint, "the bucket answers again"),
            None => {}
        }
    }
}

impl Drop for UnderWay<'_> {
    fn drop(&mut self) {
        if let Some(permit) = self.permit.take() {
            self.buckets.given_up(&self.id, permit);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::future::{pending, ready};

    use super::*;
    use crate::services::archive::Cause;

    const LIMIT: Duration = Duration::from_secs(10);

    fn storage(bucket: &str) -> Storage {
        serde_json::from_value(serde_json::json!({ "bucket": bucket })).unwrap()
    }

    fn refused(cause: Cause) -> Result<(), ArchiveError> {
        Err(ArchiveError {
            op: "reading",
            object: "one/7/x".into(),
            cause,
        })
    }

    async fn hang(buckets: &Buckets, storage: &Storage) -> (Duration, String) {
        let began = Instant::now();
        let error = buckets.call::<()>(storage, LIMIT, pending()).await.unwrap_err();
        (began.elapsed(), error.to_string())
    }

    #[tokio::test(start_paused = true)]
    async fn after_one_silence_all_are_answered_at_once_with_the_same_words() {
        let (buckets, one) = (Buckets::default(), storage("one"));
        let (took, first) = hang(&buckets, &one).await;
        assert_eq!((took, first.as_str()), (LIMIT, "the bucket one did not answer in time"));
        for _ in 0..300 {
            assert_eq!(hang(&buckets, &one).await, (Duration::ZERO, first.clone()));
        }
        let other = buckets.call(&storage("two"), LIMIT, ready(Ok(7))).await;
        assert_eq!(other.unwrap(), 7, "another bucket is asked");

        tokio::time::advance(Duration::from_secs(5)).await;
        let mut probe = std::pin::pin!(buckets.call(&one, LIMIT, async {
            tokio::time::sleep(Duration::from_secs(1)).await;
            Ok(())
        }));
        assert!(probe.as_mut().now_or_never().is_none());
        assert_eq!(hang(&buckets, &one).await.0, Duration::ZERO, "one probe at a time");
        probe.await.unwrap();
        buckets.call(&one, LIMIT, ready(Ok(()))).await.unwrap();
    }

    #[tokio::test(start_paused = true)]
    async fn what_is_large_opens_nothing_and_is_kept_from_a_bucket_that_hangs() {
        let (buckets, one) = (Buckets::default(), storage("one"));
        let error = buckets.call_large::<()>(&one, LIMIT, pending()).await.unwrap_err();
        assert_eq!(error.to_string(), "the bucket one did not answer in time");
        assert!(buckets.lock().is_empty());
        hang(&buckets, &one).await;
        let began = Instant::now();
        buckets.call_large::<()>(&one, LIMIT, pending()).await.unwrap_err();
        tokio::time::advance(Duration::from_secs(5)).await;
        buckets.call_large(&one, LIMIT, ready(Ok(()))).await.unwrap_err();
        assert_eq!(began.elapsed(), Duration::from_secs(5), "it is no probe");
        buckets.call(&one, LIMIT, ready(Ok(()))).await.unwrap();
        buckets.call_large(&one, LIMIT, ready(Ok(()))).await.unwrap();
    }

    #[tokio::test(start_paused = true)]
    async fn what_is_an_answer_opens_nothing() {
        let (buckets, one) = (Buckets::default(), storage("one"));
        let denied = || Cause::Denied("status 403".into());
        let away = || Cause::Away("status 503".into());
        for cause in [denied(), Cause::NoBucket, away()] {
            let words = cause.to_string();
            let error = buckets.call(&one, LIMIT, ready(refused(cause))).await.unwrap_err();
            assert!(error.to_string().contains(&words), "{error}");
            assert!(buckets.lock().is_empty());
        }
        let late = |cause, seconds| async move {
            tokio::time::sleep(Duration::from_secs(seconds)).await;
            refused(cause)
        };
        buckets.call(&one, LIMIT, late(denied(), 9)).await.unwrap_err();
        assert!(buckets.lock().is_empty(), "a slow answer is one");
        buckets.call(&one, LIMIT, late(away(), 5)).await.unwrap_err();
        assert_eq!(hang(&buckets, &one).await.0, Duration::ZERO, "no connection for 5 s");
        tokio::time::advance(Duration::from_secs(5)).await;
        buckets.call(&one, LIMIT, ready(refused(denied()))).await.unwrap_err();
        buckets.call(&one, LIMIT, ready(Ok(()))).await.unwrap();
    }

    #[tokio::test(start_paused = true)]
    async fn a_pass_that_ends_in_the_middle_of_the_probe_leaves_it_to_another() {
        let (buckets, one) = (Buckets::default(), storage("one"));
        hang(&buckets, &one).await;
        tokio::time::advance(Duration::from_secs(5)).await;
        let probe = buckets.call::<()>(&one, LIMIT, pending());
        assert!(tokio::time::timeout(Duration::from_secs(1), probe).await.is_err());
        assert_eq!(hang(&buckets, &one).await.0, Duration::ZERO);
        tokio::time::advance(Duration::from_secs(5)).await;
        buckets.call(&one, LIMIT, ready(Ok(()))).await.unwrap();
    }

    #[tokio::test(start_paused = true)]
    async fn only_buckets_that_hang_are_kept_in_mind() {
        let buckets = Buckets::default();
        for number in 0..50 {
            hang(&buckets, &storage(&format!("bucket-{number}"))).await;
            tokio::time::advance(Duration::from_mins(1)).await;
        }
        assert!(buckets.lock().len() <= 11, "{}", buckets.lock().len());
    }
}
