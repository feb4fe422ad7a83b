//! What waits for a turn. The lanes take turns: one is for what has just come and may be short, the other for what
//! is known to be long. In each the tenants take turns, and the connections of each tenant.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, PoisonError};

use crate::core::connection::Connection;
use crate::core::mutex::lock;
use crate::core::tenant::Tenant;

/// Whether a job counts against the limit of those that wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Admission {
    /// Refused when the queue is full.
    Bounded,
    /// Part of something that was admitted.
    Granted,
}

/// A job, told its number.
pub(super) type Work = Box<dyn FnOnce(u64) + Send>;

/// Where a job waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Lane {
    /// It has not had a turn yet, and may be done within one.
    Short,
    /// It takes many turns.
    Long,
}

/// What waits.
pub(super) enum Ticket {
    /// A job that has not begun.
    Begin { id: u64, admission: Admission, work: Work },
    /// A job that has begun; it holds a thread meanwhile.
    GoOn { id: u64, baton: Arc<Baton> },
}

impl Ticket {
    fn id(&self) -> u64 {
        match self {
            Self::Begin { id, .. } | Self::GoOn { id, .. } => *id,
        }
    }

    fn is_bounded(&self) -> bool {
        matches!(self, Self::Begin { admission: Admission::Bounded, .. })
    }
}

/// What the next turn of a connection may be for.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum May {
    /// It has all the turns that it may have.
    Nothing,
    /// There is no thread for another job.
    GoOn,
    Begin,
}

impl May {
    fn admits(self, ticket: &Ticket) -> bool {
        match ticket {
            Ticket::Begin { .. } => self == Self::Begin,
            Ticket::GoOn { .. } => self != Self::Nothing,
        }
    }
}

/// What a thread waits for that has passed its turn on.
#[derive(Default)]
pub(super) struct Baton {
    is_here: Mutex<bool>,
    arrived: Condvar,
}

impl Baton {
    pub(super) fn pass(&self) {
        *lock(&self.is_here) = true;
        self.arrived.notify_one();
    }

    pub(super) fn wait(&self) {
        let mut is_here = lock(&self.is_here);
        while !*is_here {
            is_here = self.arrived.wait(is_here).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

/// The tickets of a lane; the connections of each tenant in the order in which it is their turn.
#[derive(Default)]
struct Connections {
    waiting: VecDeque<(Connection, VecDeque<Ticket>)>,
    /// When each tenant that waits had its last turn, in turns.
    last_turns: HashMap<Tenant, u64>,
    turns: u64,
}

/// The queue.
#[derive(Default)]
pub(super) struct Queue {
    short: Connections,
    long: Connections,
    last_was_short: bool,
}

impl Queue {
    pub(super) fn is_empty(&self) -> bool {
        self.short.waiting.is_empty() && self.long.waiting.is_empty()
    }

    /// Jobs that have not begun.
    pub(super) fn waiting(&self) -> usize {
        let tickets = self.short.waiting.iter().chain(&self.long.waiting).flat_map(|(_, all)| all);
        tickets.filter(|ticket| matches!(ticket, Ticket::Begin { .. })).count()
    }

    pub(super) fn push(&mut self, lane: Lane, connection: Connection, ticket: Ticket) {
        let connections = match lane {
            Lane::Short => &mut self.short,
            Lane::Long => &mut self.long,
        };
        match connections.waiting.iter_mut().find(|(owner, _)| *owner == connection) {
            Some((_, tickets)) => tickets.push_back(ticket),
            None => connections.waiting.push_back((connection, VecDeque::from([ticket]))),
        }
    }

    /// The next that may have a turn.
    pub(super) fn pop(&mut self, may: impl Fn(Connection) -> May) -> Option<(Connection, Ticket)> {
        for is_short in [!self.last_was_short, self.last_was_short] {
            let connections = if is_short { &mut self.short } else { &mut self.long };
            if let Some(next) = pop(connections, &may) {
                self.last_was_short = is_short;
                return Some(next);
            }
        }
        None
    }

    /// Takes what has not begun out.
    pub(super) fn remove(&mut self, id: u64) -> Option<Ticket> {
        let is_it = |ticket: &Ticket| matches!(ticket, Ticket::Begin { .. }) && ticket.id() == id;
        [&mut self.short, &mut self.long].into_iter().find_map(|connections| {
            let place =
                |(_, tickets): &(Connection, VecDeque<Ticket>)| tickets.iter().position(is_it);
            let (i, k) = connections
                .waiting
                .iter()
                .enumerate()
                .find_map(|(i, connection)| Some((i, place(connection)?)))?;
            take(connections, i, k).map(|(_, ticket)| ticket)
        })
    }

    pub(super) fn holds(&self, id: u64) -> bool {
        self.tickets().any(|(_, ticket)| ticket.id() == id)
    }

    /// Jobs of a connection that wait to begin and are counted, and those of all connections.
    pub(super) fn counted(&self, connection: Connection) -> (usize, usize) {
        let counted = || self.tickets().filter(|(_, ticket)| ticket.is_bounded());
        (counted().filter(|(owner, _)| *owner == connection).count(), counted().count())
    }

    fn tickets(&self) -> impl Iterator<Item = (Connection, &Ticket)> {
        let connections = self.short.waiting.iter().chain(&self.long.waiting);
        connections
            .flat_map(|(connection, tickets)| tickets.iter().map(|ticket| (*connection, ticket)))
    }
}

fn pop(
    connections: &mut Connections,
    may: &impl Fn(Connection) -> May,
) -> Option<(Connection, Ticket)> {
    let place = |(connection, tickets): &(Connection, VecDeque<Ticket>)| {
        let may = may(*connection);
        if may == May::Nothing {
            return None;
        }
        tickets.iter().position(|ticket| may.admits(ticket))
    };
    // Of those who may, the tenant that has waited longest; of its connections the first.
    let last_turn = |connection: Connection| {
        connections.last_turns.get(&connection.tenant()).copied().unwrap_or_default()
    };
    let (i, k) = connections
        .waiting
        .iter()
        .enumerate()
        .filter_map(|(i, waiting)| Some((i, place(waiting)?, last_turn(waiting.0))))
        .min_by_key(|(_, _, last_turn)| *last_turn)
        .map(|(i, k, _)| (i, k))?;
    let tenant = connections.waiting[i].0.tenant();
    connections.turns += 1;
    connections.last_turns.insert(tenant, connections.turns);
    let taken = take(connections, i, k);
    if connections.waiting.is_empty() {
        connections.last_turns.clear();
    }
    taken
}

/// Takes a ticket of a connection, who is the last one after that.
fn take(connections: &mut Connections, i: usize, k: usize) -> Option<(Connection, Ticket)> {
    let (connection, mut tickets) = connections.waiting.remove(i)?;
    let ticket = tickets.remove(k)?;
    if !tickets.is_empty() {
        connections.waiting.push_back((connection, tickets));
    }
    Some((connection, ticket))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::connection::Sight;
    use crate::core::connection::tests::connection;
    use crate::core::room::Room;
    use crate::core::tenant::Tenants;

    fn begin(id: u64) -> Ticket {
        Ticket::Begin { id, admission: Admission::Bounded, work: Box::new(|_| {}) }
    }

    fn go_on(id: u64) -> Ticket {
        Ticket::GoOn { id, baton: Arc::default() }
    }

    fn ids(queue: &mut Queue, may: impl Fn(Connection) -> May) -> Vec<u64> {
        std::iter::from_fn(|| queue.pop(&may)).map(|(_, ticket)| ticket.id()).collect()
    }

    #[test]
    fn connections_and_lanes_take_turns() {
        let mut queue = Queue::default();
        for id in 10..14 {
            queue.push(Lane::Long, connection(1), begin(id));
        }
        queue.push(Lane::Long, connection(2), begin(20));
        queue.push(Lane::Short, connection(1), begin(30));
        queue.push(Lane::Short, connection(3), begin(31));
        assert_eq!(ids(&mut queue, |_| May::Begin), [30, 10, 31, 20, 11, 12, 13]);
        assert!(queue.is_empty());
    }

    #[test]
    fn tenants_take_turns_however_many_connections_they_have() {
        let room = Room::new("numbers", "numbers", 1);
        let tenants = Tenants::new(true, Default::default(), &room, &room);
        let of = |number, name| Connection::of_tenant(number, tenants.named(name), Sight::Own);
        let mut queue = Queue::default();
        for number in 1..=3 {
            queue.push(Lane::Long, of(number, "many"), begin(number));
            queue.push(Lane::Long, of(number, "many"), begin(10 + number));
        }
        for id in 20..23 {
            queue.push(Lane::Long, of(4, "one"), begin(id));
        }
        assert_eq!(ids(&mut queue, |_| May::Begin), [1, 20, 2, 21, 3, 22, 11, 12, 13]);
    }

    #[test]
    fn nobody_waits_for_those_who_may_not() {
        let mut queue = Queue::default();
        queue.push(Lane::Long, connection(1), begin(10));
        queue.push(Lane::Long, connection(1), go_on(11));
        queue.push(Lane::Long, connection(2), begin(20));
        queue.push(Lane::Long, connection(3), begin(30));
        let may = |owner| match owner {
            owner if owner == connection(1) => May::GoOn,
            owner if owner == connection(2) => May::Nothing,
            _ => May::Begin,
        };
        assert_eq!(ids(&mut queue, may), [11, 30]);
        assert!(queue.holds(20) && !queue.holds(30));
        assert_eq!(queue.counted(connection(2)), (1, 2));
        assert!(queue.remove(20).is_some() && queue.remove(20).is_none());
        assert_eq!(ids(&mut queue, |_| May::Begin), [10]);
    }
}
