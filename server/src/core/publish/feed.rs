//! All that brings a plant's steps to its watchers.

use crate::core::publish::frame::Published;
use crate::core::publish::relay::Relay;
use crate::core::publish::watchers::Watchers;

/// The watchers of a plant, and the way of its own loop's steps to them.
#[derive(Default)]
pub(crate) struct Feed {
    pub(crate) watchers: Watchers,
    pub(crate) relay: Relay,
}

impl Feed {
    /// Hands on what is on its way from the plant's own loop.
    pub(crate) fn hand_on(&self) {
        self.relay.hand_on(&self.watchers);
    }

    /// Tells the watchers of the state of a plant at rest, after what is on its way from its own loop.
    pub(crate) fn publish(&self, published: &Published<'_>) {
        self.hand_on();
        self.watchers.publish(published);
    }
}
