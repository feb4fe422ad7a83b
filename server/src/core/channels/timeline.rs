//! Numbers of the scene that change on schedule.
//!
//! For each set of changes that can be in force together a spare plant is made ahead, off the control path.
//! A step looks which set is wanted, and if it is another one, that plant takes over the state.

use std::collections::BTreeSet;
use std::sync::Arc;

use plantd_models::{InitialError, Model, Plant, Settings, Site, Spare};

use crate::core::channels::fault::{Pattern, Schedule};
use crate::core::limits::{LimitExceeded, Limits};
use crate::core::parameters::{self, ChangeError, Parameters};

/// Why changes of parameters cannot be made ready.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(crate) enum TimelineError {
    /// A change is refused.
    #[error(transparent)]
    Change(#[from] ChangeError),
    /// Too many sets of changes, or too many changed numbers.
    #[error(transparent)]
    Limit(#[from] LimitExceeded),
    /// The changed mechanics are none.
    #[error(transparent)]
    Plant(#[from] InitialError),
    /// More than six changes come and go at the same time.
    #[error("has too many changes that come and go at the same time")]
    TooManyBlinking,
}

/// A set of changes, by the bits of their numbers.
pub(crate) type Set = u64;

/// Most changes at a time that are not in force all the time: each doubles the sets.
const BLINKING_MAX: usize = 6;

/// Plants for the sets of changes.
#[derive(Clone, Debug)]
pub(crate) struct Timeline {
    base: Base,
    /// What the changed numbers are without changes.
    unchanged: Arc<Parameters>,
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
    /// The set's model, wherever its plant is.
    model: Arc<Model>,
    plant: Spare,
    parameters: Arc<Parameters>,
    /// Those of outputs and pushes, in the order of [`crate::core::channels::pipeline::Channels::sites_mut`].
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

/// What a recorder needs to know of changes to come.
#[derive(Clone, Debug, Default)]
pub(crate) struct Announced {
    /// What the numbers are without changes.
    pub(crate) unchanged: Arc<Parameters>,
    /// The models that can be in force, with what is changed in them.
    pub(crate) models: Vec<(Arc<Model>, Arc<Parameters>)>,
}

impl Timeline {
    /// Compiles a model for each set: call it on a worker.
    pub(crate) fn new(
        base: &Base,
        changes: &[Change],
        sites: impl Fn(&Model) -> Vec<Site>,
        limits: &Limits,
    ) -> Result<Self, TimelineError> {
        let (mut entries, mut unchanged) = (Vec::new(), Parameters::new());
        for set in sets(changes, limits)? {
            let (mut model, mut parameters) =
                (Arc::clone(&base.model), Arc::clone(&base.parameters));
            let chosen = changes.iter().enumerate().filter(|(bit, _)| set >> bit & 1 == 1);
            for (_, change) in chosen {
                let changed = parameters::change(&model, &parameters, &change.numbers);
                let changed = changed?;
                // The first change of a number in a set is one of the base.
                for (path, former) in changed.former {
                    unchanged.entry(path).or_insert(former);
                }
                (model, parameters) = (Arc::new(changed.model), Arc::new(changed.parameters));
            }
            let (what, count) = ("numbers of the scene changed", parameters.len());
            LimitExceeded::check("parameters", limits.parameters, what, count)?;
            let sites = sites(&model);
            let plant = Spare::new(Arc::clone(&model), base.settings);
            let plant = plant?;
            entries.push(Entry { set, model, plant, parameters, sites });
        }
        let (base, unchanged) = (base.clone(), Arc::new(unchanged));
        Ok(Self { base, unchanged, entries, current: None, asked: None, is_refused: false })
    }

    /// The mechanics without changes.
    pub(crate) fn base(&self) -> &Base {
        &self.base
    }

    /// What a recorder needs to know.
    pub(crate) fn announced(&self) -> Announced {
        let model = |entry: &Entry| (Arc::clone(&entry.model), Arc::clone(&entry.parameters));
        Announced {
            unchanged: Arc::clone(&self.unchanged),
            models: self.entries.iter().map(model).collect(),
        }
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
        let was = self.current;
        let wanted = self.entries.iter().position(|entry| entry.set == set);
        self.is_refused = !wanted.is_some_and(|wanted| self.relieve(wanted, plant, sites));
        self.current != was
    }

    /// Finds the plant that the core has among its own, or one that is equal.
    pub(crate) fn adopt<'a>(
        &mut self,
        plant: &mut Plant,
        sites: impl Iterator<Item = &'a mut Site>,
    ) {
        if let Some(same) = self.entry_of(plant) {
            self.relieve(same, plant, sites);
        }
    }

    /// A copy of one of the plants has taken the place of the one that was in force, the `former`, which is
    /// put where it belongs; what comes back in its stead is not needed any more. True when the copy is of
    /// another set.
    pub(crate) fn follow<'a>(
        &mut self,
        copy: &Plant,
        former: &mut Spare,
        sites: impl Iterator<Item = &'a mut Site>,
    ) -> bool {
        let other = self.entry_of(copy).filter(|same| self.current != Some(*same));
        if let Some(other) = other {
            std::mem::swap(former, &mut self.entries[other].plant);
            self.enter(other, sites);
        }
        other.is_some()
    }

    /// The entry of a plant's model.
    fn entry_of(&self, plant: &Plant) -> Option<usize> {
        self.entries.iter().position(|entry| entry.model.digest() == plant.model().digest())
    }

    /// The plant is in another state: what could not be done may be possible.
    pub(crate) fn begin(&mut self) {
        self.asked = None;
        self.is_refused = false;
    }

    /// Puts an entry in force, if it is not and its constraints allow it; whether it is then.
    fn relieve<'a>(
        &mut self,
        wanted: usize,
        plant: &mut Plant,
        sites: impl Iterator<Item = &'a mut Site>,
    ) -> bool {
        if Some(wanted) == self.current {
            return true;
        }
        let is_relieved = self.entries[wanted].plant.relieve(plant).is_ok();
        if is_relieved {
            self.enter(wanted, sites);
        }
        is_relieved
    }

    /// An entry has changed places with the plant in force: all else of it does, too.
    fn enter<'a>(&mut self, wanted: usize, sites: impl Iterator<Item = &'a mut Site>) {
        for (present, site) in sites.zip(&mut self.entries[wanted].sites) {
            std::mem::swap(present, site);
        }
        // What was in force goes from the place of its successor to its own.
        if let Some(current) = self.current
            && let Ok([from, to]) = self.entries.get_disjoint_mut([wanted, current])
        {
            std::mem::swap(&mut from.plant, &mut to.plant);
            std::mem::swap(&mut from.sites, &mut to.sites);
        }
        self.current = Some(wanted);
    }

    /// Numbers that are changed in the set in force.
    pub(crate) fn parameters(&self) -> Option<Arc<Parameters>> {
        self.current.map(|current| Arc::clone(&self.entries[current].parameters))
    }

    /// Copies of all plants, the one in the core's hands among them.
    pub(crate) fn copies(&self, present: &Plant) -> Vec<Spare> {
        let plant = |(index, entry): (usize, &Entry)| {
            if self.current == Some(index) { present.clone().into() } else { entry.plant.clone() }
        };
        self.entries.iter().enumerate().map(plant).collect()
    }
}

/// The sets that can be in force, the empty one first.
fn sets(changes: &[Change], limits: &Limits) -> Result<BTreeSet<Set>, TimelineError> {
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
            return Err(TimelineError::TooManyBlinking);
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
