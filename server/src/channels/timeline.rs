//! Numbers of the scene that change on schedule.
//!
//! For each set of changes that can be in force together a plant is made ahead, off the control path. A step
//! looks which set is wanted, and if it is another one, that plant takes over the state.

use std::collections::BTreeSet;
use std::sync::Arc;

use plantd_models::{Model, Plant, Settings, Site};

use super::fault::{Pattern, Schedule};
use crate::limits::{LimitExceeded, Limits};
use crate::parameters::{self, ChangeError, Parameters};
use crate::status::Fault;

/// A set of changes, by the bits of their numbers.
pub(crate) type Set = u64;

/// Most changes at a time that are not in force all the time: each doubles the sets.
const BLINKING_MAX: usize = 6;

/// Plants for the sets of changes.
#[derive(Clone, Debug)]
pub(crate) struct Timeline {
    base: Base,
    /// By set; the first has no changes. That of the set in force holds what the core had before.
    entries: Vec<Entry>,
    /// Which entry's plant the core has.
    current: Option<usize>,
    /// The set that was last asked for.
    asked: Option<Set>,
    /// The state did not satisfy the constraints of the set that was last asked for.
    pub(crate) is_refused: bool,
}

#[derive(Clone, Debug)]
struct Entry {
    set: Set,
    plant: Plant,
    parameters: Arc<Parameters>,
    /// Those of outputs and pushes, in the order of [`super::Channels::sites_mut`].
    sites: Vec<Site>,
}

/// A change with its schedule.
pub(crate) struct Change {
    pub(crate) schedule: Schedule,
    pub(crate) numbers: Vec<(String, f64)>,
}

/// The mechanics without changes.
#[derive(Clone, Debug)]
pub(crate) struct Base {
    pub(crate) model: Arc<Model>,
    pub(crate) parameters: Arc<Parameters>,
    pub(crate) settings: Settings,
}

impl Timeline {
    /// Compiles a model for each set: call it on a worker.
    pub(crate) fn new(
        base: &Base,
        changes: &[Change],
        sites: impl Fn(&Model) -> Vec<Site>,
        limits: &Limits,
    ) -> Result<Self, Fault> {
        let mut entries = Vec::new();
        for set in sets(changes, limits)? {
            let (mut model, mut parameters) =
                (Arc::clone(&base.model), Arc::clone(&base.parameters));
            let chosen = changes.iter().enumerate().filter(|(bit, _)| set >> bit & 1 == 1);
            for (_, change) in chosen {
                let changed = parameters::change(&model, &parameters, &change.numbers);
                let changed = changed.map_err(refused)?;
                (model, parameters) = (Arc::new(changed.model), Arc::new(changed.parameters));
            }
            let (what, count) = ("numbers of the scene changed", parameters.len());
            LimitExceeded::check("parameters", limits.parameters, what, count)?;
            let sites = sites(&model);
            let plant = Plant::new(model, base.settings);
            let plant = plant.map_err(|error| Fault::from_initial(error, "fault.parameters"))?;
            entries.push(Entry { set, plant, parameters, sites });
        }
        Ok(Self { base: base.clone(), entries, current: None, asked: None, is_refused: false })
    }

    /// The mechanics without changes.
    pub(crate) fn base(&self) -> &Base {
        &self.base
    }

    /// Puts the plant of a set in force, if it is not; true when it has changed. Allocates nothing unless
    /// it is refused.
    pub(crate) fn ask<'a>(
        &mut self,
        set: Set,
        plant: &mut Plant,
        sites: impl Iterator<Item = &'a mut Site>,
    ) -> bool {
        if self.asked == Some(set) {
            return false;
        }
        self.asked = Some(set);
        let wanted = self.entries.iter().position(|entry| entry.set == set);
        if wanted.is_some() && wanted == self.current {
            self.is_refused = false;
            return false;
        }
        let taken = wanted.filter(|&wanted| self.entries[wanted].plant.go_on_from(plant).is_ok());
        self.is_refused = taken.is_none();
        let Some(wanted) = taken else { return false };
        let entry = &mut self.entries[wanted];
        std::mem::swap(plant, &mut entry.plant);
        for (present, site) in sites.zip(&mut entry.sites) {
            std::mem::swap(present, site);
        }
        if let Some(current) = self.current {
            self.put_back(wanted, current);
        }
        self.current = Some(wanted);
        true
    }

    /// What was in force goes from the place of its successor to its own.
    fn put_back(&mut self, from: usize, to: usize) {
        if let Ok([from, to]) = self.entries.get_disjoint_mut([from, to]) {
            std::mem::swap(&mut from.plant, &mut to.plant);
            std::mem::swap(&mut from.sites, &mut to.sites);
        }
    }

    /// Numbers that are changed in the set in force.
    pub(crate) fn parameters(&self) -> Option<Arc<Parameters>> {
        self.current.map(|current| Arc::clone(&self.entries[current].parameters))
    }

    /// Copies of all plants, the one in the core's hands among them.
    pub(crate) fn copies(&self, present: &Plant) -> Vec<Plant> {
        let plant = |(index, entry): (usize, &Entry)| {
            if self.current == Some(index) { present.clone() } else { entry.plant.clone() }
        };
        self.entries.iter().enumerate().map(plant).collect()
    }

    /// A copy of one of the plants has taken the place of the one in force, which is `former`. Returns what is
    /// left, and the numbers that are changed now.
    pub(crate) fn replaced(
        &mut self,
        former: Plant,
        present: &Plant,
    ) -> (Plant, Option<Arc<Parameters>>) {
        self.asked = None;
        let rest = match self.current.take() {
            Some(current) => std::mem::replace(&mut self.entries[current].plant, former),
            None => former,
        };
        let is_it = |entry: &&Entry| Arc::ptr_eq(entry.plant.model(), present.model());
        let parameters = self.entries.iter().find(is_it).map(|entry| Arc::clone(&entry.parameters));
        (rest, parameters)
    }
}

fn refused(error: ChangeError) -> Fault {
    match error {
        ChangeError::Path { index, problem } => {
            Fault::field(format!("fault.parameters.parameters[{index}].path"), problem)
        }
        error => error.into(),
    }
}

/// The sets that can be in force, the empty one first.
fn sets(changes: &[Change], limits: &Limits) -> Result<BTreeSet<Set>, Fault> {
    let (name, limit) = ("parameter_sets", limits.parameter_sets);
    let what = "sets of changed parameters that can be in force together";
    LimitExceeded::check(name, limit.min(64), what, changes.len())?;
    let schedules = || changes.iter().map(|change| change.schedule).enumerate();
    let starts = schedules().map(|(_, schedule)| schedule.start);
    let ends = schedules().filter_map(|(_, schedule)| schedule.end);
    let mut sets = BTreeSet::from([0]);
    for step in starts.chain(ends) {
        let covers = |schedule: &Schedule| schedule.start <= step && !schedule.is_over(step);
        let mut blinking: Vec<usize> = Vec::new();
        let mut lasting: Set = 0;
        for (bit, schedule) in schedules().filter(|(_, schedule)| covers(schedule)) {
            match schedule.pattern {
                Pattern::Always => lasting |= 1 << bit,
                _ => blinking.push(bit),
            }
        }
        LimitExceeded::check(name, limit, what, 1 << blinking.len().min(BLINKING_MAX + 1))?;
        if blinking.len() > BLINKING_MAX {
            let problem = "has too many changes that come and go at the same time";
            return Err(Fault::field("fault.parameters", problem));
        }
        for subset in 0..1_u64 << blinking.len() {
            let chosen = blinking.iter().enumerate().filter(|(i, _)| subset >> i & 1 == 1);
            sets.insert(chosen.fold(lasting, |set, (_, bit)| set | 1 << bit));
        }
        LimitExceeded::check(name, limit, what, sets.len())?;
    }
    Ok(sets)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change(start: u64, end: Option<u64>, pattern: Pattern) -> Change {
        Change { schedule: Schedule { start, end, pattern }, numbers: Vec::new() }
    }

    #[test]
    fn sets_are_those_that_meet() {
        let limits = Limits::default();
        let blink = Pattern::Intermittent { period: 4, on: 2 };
        let changes = [
            change(10, Some(20), Pattern::Always),
            change(15, Some(30), Pattern::Always),
            change(40, None, Pattern::Always),
            change(18, Some(25), blink),
        ];
        let found: Vec<Set> = sets(&changes, &limits).unwrap().into_iter().collect();
        assert_eq!(found, [0b0000, 0b0001, 0b0010, 0b0011, 0b0100, 0b1010, 0b1011]);
        let few = Limits { parameter_sets: 6, ..limits };
        assert!(sets(&changes, &few).is_err());
        let many: Vec<Change> = (0..7).map(|_| change(0, None, blink)).collect();
        assert!(sets(&many, &Limits::default()).is_err());
    }
}
