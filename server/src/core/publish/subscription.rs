//! A watcher's end.

use std::future::poll_fn;
use std::sync::Arc;
use std::task::{Context, Poll};

use crate::core::limits::LimitExceeded;
use crate::core::metrics::registry::Metrics;
use crate::core::mutex::lock;
use crate::core::publish::feed::Feed;
use crate::core::publish::frame::{Frame, Published};
use crate::core::publish::watchers::Slot;

/// A watcher's place; dropping it ends the watch.
pub struct Subscription {
    feed: Arc<Feed>,
    metrics: Arc<Metrics>,
    slot: Arc<Slot>,
    frame: Frame,
    dropped: u64,
    passes_over: bool,
}

impl Subscription {
    /// Begins to watch.
    pub(crate) fn new(
        feed: Arc<Feed>,
        metrics: Arc<Metrics>,
        every: u64,
        from: u64,
        frames: Vec<Frame>,
        watchers_max: u64,
    ) -> Result<Self, LimitExceeded> {
        let frame = frames.first().cloned().unwrap_or_default();
        let slot = Arc::new(Slot::new(every, from, frames));
        feed.watchers.add(Arc::clone(&slot), watchers_max)?;
        metrics.watcher_started();
        Ok(Self { feed, metrics, slot, frame, dropped: 0, passes_over: false })
    }

    pub(crate) fn offer(&self, published: &Published<'_>) {
        self.slot.offer(published);
    }

    /// Waits for the next frame; returns it with the number of frames lost so far.
    pub async fn next(&mut self) -> (&Frame, u64) {
        poll_fn(|context| self.poll_taken(context)).await;
        (&self.frame, self.dropped)
    }

    /// From now on the latest frame is what is wanted: those before it are passed over, and not lost.
    pub fn pass_over(&mut self) {
        self.passes_over = true;
    }

    /// The next frame, with the number of frames lost so far.
    pub fn poll_next(&mut self, context: &mut Context<'_>) -> Poll<(&Frame, u64)> {
        self.poll_taken(context).map(|()| (&self.frame, self.dropped))
    }

    fn poll_taken(&mut self, context: &mut Context<'_>) -> Poll<()> {
        if self.take() {
            return Poll::Ready(());
        }
        self.slot.filled.register(context.waker());
        // A frame may have come in between.
        if self.take() { Poll::Ready(()) } else { Poll::Pending }
    }

    /// Fetches the frame in the slot, if it is a new one.
    fn take(&mut self) -> bool {
        let mut cell = lock(&self.slot.cell);
        if !cell.pop(&mut self.frame) {
            return false;
        }
        if self.passes_over {
            cell.dropped = self.dropped;
        }
        let lost = cell.dropped - self.dropped;
        self.dropped = cell.dropped;
        drop(cell);
        self.metrics.watch_dropped(lost);
        true
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.feed.watchers.remove(&self.slot);
        self.metrics.watcher_ended();
    }
}
