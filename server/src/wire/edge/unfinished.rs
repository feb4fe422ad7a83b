//! Messages that have not come wholly: one budget for all of them together, and a time for each.
//!
//! A message is held until its last byte has come. What comes in one piece, as the messages of a
//! control loop do, is not counted; a body whose messages come in several pieces reserves the bytes
//! of the longest one and keeps them until it ends, because its decoder keeps the buffer.
//!
//! Long messages are also walked through as they come, and refused when they have too many parts: see
//! [`crate::wire::edge::parts`].

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use http_body::{Body as HttpBody, Frame, SizeHint};
use tokio::time::{Instant, Sleep, sleep_until};
use tonic::body::Body;
use tonic::{Code, Status};

use crate::core::limits::{LimitExceeded, Limits};
use crate::core::rate::Rate;
use crate::wire::edge::parts::{self, Malformed, PART_BYTES_MIN, Walk};
use crate::wire::status::RpcError;

/// A second more for this many bytes, so that a long message may come over a slow line.
const BYTES_PER_SECOND: u64 = 64 << 10;

/// What unfinished messages may take.
pub(crate) struct Budget {
    bytes: u64,
    seconds: u64,
    parts: u64,
    held: AtomicU64,
}

impl Budget {
    pub(crate) fn new(limits: &Limits) -> Self {
        Self {
            bytes: limits.unfinished_message_bytes,
            seconds: limits.message_s,
            parts: limits.message_parts,
            held: AtomicU64::new(0),
        }
    }

    /// The body of a request to this path, which keeps to the budget, and to the rate of messages of its tenant.
    pub(crate) fn follow(
        self: &Arc<Self>,
        path: &str,
        body: Body,
        rate: Option<Arc<Rate>>,
    ) -> Body {
        Body::new(Followed {
            body,
            budget: Arc::clone(self),
            rate,
            position: Position::of(parts::request_of(path), self.parts),
            held: 0,
            times: None,
            timer: None,
        })
    }

    fn reserve(&self, bytes: u64) -> Result<(), LimitExceeded> {
        let held = self.held.fetch_add(bytes, Ordering::Relaxed) + bytes;
        if held <= self.bytes {
            return Ok(());
        }
        self.held.fetch_sub(bytes, Ordering::Relaxed);
        let (name, limit) = ("unfinished_message_bytes", self.bytes);
        Err(LimitExceeded { name, limit, what: "bytes of unfinished messages", actual: held })
    }

    fn overdue(&self) -> LimitExceeded {
        let (name, limit) = ("message_s", self.seconds);
        LimitExceeded {
            name,
            limit,
            what: "seconds for a message",
            actual: limit.saturating_add(1),
        }
    }
}

/// Why nothing more is read of a message.
#[derive(Debug)]
enum Refused {
    Limit(LimitExceeded),
    Malformed,
}

impl From<LimitExceeded> for Refused {
    fn from(error: LimitExceeded) -> Self {
        Self::Limit(error)
    }
}

impl From<Malformed> for Refused {
    fn from(_: Malformed) -> Self {
        Self::Malformed
    }
}

impl From<Refused> for RpcError {
    fn from(refused: Refused) -> Self {
        let sentence = "the bytes are not a message that this method takes";
        match refused {
            Refused::Limit(error) => error.into(),
            Refused::Malformed => Self::new(Code::InvalidArgument, "PROTOCOL", sentence),
        }
    }
}

/// Where a body stands in its messages, each a flag, a length of four bytes and as many bytes.
struct Position {
    /// The message that the method takes, and how many parts it may have.
    request: Option<usize>,
    parts: u64,
    head: [u8; 5],
    /// Bytes of the head that have come.
    in_head: usize,
    /// Bytes that have come of a message that is not whole, with its head.
    came: u64,
    /// Bytes that it lacks, once its head is whole.
    lacks: usize,
    /// Counts its parts, if it is long enough for too many.
    walk: Option<Walk>,
}

impl Position {
    fn of(request: Option<usize>, parts: u64) -> Self {
        Self { request, parts, head: [0; 5], in_head: 0, came: 0, lacks: 0, walk: None }
    }

    /// Goes on by what has come; how many messages are whole by that.
    fn advance(&mut self, mut piece: &[u8]) -> Result<u64, Refused> {
        let mut whole = 0;
        while !piece.is_empty() {
            if self.in_head < self.head.len() {
                let count = piece.len().min(self.head.len() - self.in_head);
                self.head[self.in_head..self.in_head + count].copy_from_slice(&piece[..count]);
                self.in_head += count;
                self.came += count as u64;
                piece = &piece[count..];
                let [_, length @ ..] = self.head;
                self.lacks = u32::from_be_bytes(length) as usize;
                let is_long = self.lacks as u64 / PART_BYTES_MIN > self.parts;
                if self.in_head == self.head.len() && is_long {
                    self.walk = self.request.map(|request| Walk::new(request, self.lacks as u64));
                }
            } else {
                let count = piece.len().min(self.lacks);
                if let Some(walk) = &mut self.walk {
                    walk.advance(&piece[..count])?;
                    let (name, limit) = ("message_parts", self.parts);
                    let what = "texts and messages within one message";
                    let actual = usize::try_from(walk.parts).unwrap_or(usize::MAX);
                    LimitExceeded::check(name, limit, what, actual)?;
                }
                self.lacks -= count;
                self.came += count as u64;
                piece = &piece[count..];
            }
            if self.in_head == self.head.len() && self.lacks == 0 {
                *self = Self::of(self.request, self.parts);
                whole += 1;
            }
        }
        Ok(whole)
    }
}

/// A body that keeps to the budget.
struct Followed {
    body: Body,
    budget: Arc<Budget>,
    rate: Option<Arc<Rate>>,
    position: Position,
    /// Bytes reserved.
    held: u64,
    /// When the message began that is not whole, and when the last piece of it came.
    times: Option<(Instant, Instant)>,
    timer: Option<Pin<Box<Sleep>>>,
}

impl Followed {
    fn take(&mut self, piece: &[u8]) -> Result<(), Refused> {
        let whole = self.position.advance(piece)?;
        if let Some(rate) = &self.rate {
            rate.take(whole)?;
        }
        let came = self.position.came;
        if came == 0 {
            self.times = None;
            return Ok(());
        }
        let now = Instant::now();
        self.times = Some((self.times.map_or(now, |(begun, _)| begun), now));
        if came > self.held {
            self.budget.reserve(came - self.held)?;
            self.held = came;
        }
        Ok(())
    }

    /// Whether a message has taken too long; otherwise the task is woken when it has.
    fn is_overdue(&mut self, context: &mut Context<'_>) -> bool {
        let Some((begun, last)) = self.times else { return false };
        let more = Duration::from_secs(self.position.came / BYTES_PER_SECOND);
        let due = last.min(begun + more) + Duration::from_secs(self.budget.seconds);
        let timer = self.timer.get_or_insert_with(|| Box::pin(sleep_until(due)));
        if timer.deadline() != due {
            timer.as_mut().reset(due);
        }
        timer.as_mut().poll(context).is_ready()
    }

    fn refuse(&mut self, refused: Refused) -> Status {
        // Nothing more is read of it.
        self.body = Body::empty();
        self.times = None;
        RpcError::from(refused).into()
    }
}

impl HttpBody for Followed {
    type Data = <Body as HttpBody>::Data;
    type Error = <Body as HttpBody>::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Self::Data>, Self::Error>>> {
        let this = &mut *self;
        let polled = Pin::new(&mut this.body).poll_frame(context);
        let kept = match &polled {
            Poll::Ready(Some(Ok(frame))) => frame.data_ref().map_or(Ok(()), |data| this.take(data)),
            Poll::Pending if this.is_overdue(context) => Err(this.budget.overdue().into()),
            _ => Ok(()),
        };
        match kept {
            Ok(()) => polled,
            Err(refused) => Poll::Ready(Some(Err(this.refuse(refused)))),
        }
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

impl Drop for Followed {
    fn drop(&mut self) {
        if self.held > 0 {
            self.budget.held.fetch_sub(self.held, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A message of this many bytes, with its head.
    fn message(length: u32) -> Vec<u8> {
        [&[0], &length.to_be_bytes()[..], &vec![7; length as usize]].concat()
    }

    #[test]
    fn what_is_not_whole_is_counted_however_it_is_cut() {
        let bytes = [message(3), message(0), message(10)].concat();
        for size in 1..=bytes.len() {
            let mut position = Position::of(None, 0);
            let mut end = 0;
            for piece in bytes.chunks(size) {
                position.advance(piece).unwrap();
                end += piece.len();
                // Where the message begins that holds the last byte.
                let begin = [0, 8, 13, 28].into_iter().rfind(|begin| *begin <= end).unwrap();
                assert_eq!(position.came, (end - begin) as u64, "pieces of {size}");
            }
        }
    }

    fn followed(budget: &Arc<Budget>) -> Followed {
        Followed {
            body: Body::empty(),
            budget: Arc::clone(budget),
            rate: None,
            position: Position::of(None, 0),
            held: 0,
            times: None,
            timer: None,
        }
    }

    #[test]
    fn the_budget_is_shared_and_comes_back() {
        let limits = Limits { unfinished_message_bytes: 100, ..Limits::default() };
        let budget = Arc::new(Budget::new(&limits));
        let held = || budget.held.load(Ordering::Relaxed);
        let (mut first, mut second) = (followed(&budget), followed(&budget));
        second.take(&message(1000)).unwrap();
        assert_eq!(held(), 0, "what is whole is not held");
        first.take(&message(60)[..64]).unwrap();
        first.take(&[7; 1]).unwrap();
        assert_eq!(held(), 64, "its decoder keeps the buffer");
        let Refused::Limit(error) = second.take(&message(60)[..60]).unwrap_err() else { panic!() };
        assert_eq!((error.name, error.limit, error.actual), ("unfinished_message_bytes", 100, 124));
        drop(first);
        second.take(&[7; 1]).unwrap();
        assert_eq!(held(), 61);
        drop(second);
        assert_eq!(held(), 0);
    }
}
