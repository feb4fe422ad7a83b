//! The derivatives of a step of a tree in space: factored in O(n), then all of them in O(n²), or products in O(n).

use plantd_math::eights::{Eight, InEights, in_eights};
use plantd_math::tree_lu::SmallestPivot;

use crate::kkt::space::columns::{AllColumns, Columns, Rows};
use crate::kkt::space::margins::{Keep, Margins, Own};
use crate::kkt::space::products::{PullBack, PushForward};
use crate::kkt::space::vectors::Vectors;
use crate::kkt::space::{Added, Factor, Limb, SpatialRecursion};
use crate::lagrangian::curvature::Curvature;
use crate::lagrangian::generators::{MatrixKind, Step};
use crate::model::mechanism::{Blocks, Model};

/// The elimination of a step, with what derivatives need of it.
#[derive(Clone, Debug)]
pub(crate) struct Eliminated<const B: usize> {
    recursion: SpatialRecursion<B>,
    margins: Margins<B>,
    columns: Columns<B>,
}

impl<const B: usize> Eliminated<B> {
    fn new(model: &Model) -> Self {
        let recursion = SpatialRecursion::new(model);
        Self { margins: Margins::new(&recursion), recursion, columns: Columns::default() }
    }

    /// Factors as [`SpatialRecursion::factor`] does.
    #[inline(never)]
    fn factor(&mut self, vectors: Vectors<'_>, own: Own<'_>, inertia: &[f64]) -> SmallestPivot {
        let Self { recursion, margins: kept, .. } = self;
        let factor = Factor { recursion, vectors, inertia };
        in_eights(FactorAndKeep { factor, keep: Keep { kept, vectors, own } })
    }

    fn make_room(&mut self) {
        self.columns.make_room(&self.recursion);
    }

    #[inline(never)]
    fn write(&mut self, rows: Rows<'_>) {
        let Self { recursion, margins, columns } = self;
        in_eights(AllColumns { recursion, margins, columns, rows });
    }

    #[inline(never)]
    fn push_forward(&mut self, by: &[f64], x: &mut [f64], momentum: &mut [f64]) {
        let Self { recursion, margins, .. } = self;
        in_eights(PushForward { recursion, margins, by, x, momentum });
    }

    #[inline(never)]
    fn pull_back(&mut self, x: &mut [f64], momentum: &[f64], by: &mut [f64]) {
        let Self { recursion, margins, .. } = self;
        in_eights(PullBack { recursion, margins, x, momentum, by });
    }

    /// Whether a linearization takes less time by columns than with so many entries in each triangle of the Newton
    /// matrix. What forks cost is in the number of limbs. Of the time entry by entry it took:
    ///
    /// ```text
    /// entries over joints and limbs      tree-7 1.2   tree-15 1.6   tree-30 2.1   tree-63 2.5   tree-127 3.1
    /// time                                      1.5           1.5          1.4           1.5            1.45
    /// entries over joints and limbs      arm of 7 hinges 3.5   balls-3 3   walker-2 4.6   walker-4 5.1   chain-8 4
    /// time                                             0.9           0.8            0.7            0.7         0.85
    /// and with vectors of two blocks     chain-8 4   quadruped 4.3   rope of 16 8   rope of 32 16
    /// time                                    1.05             1.2           0.75            0.43
    /// and with three                     rope of 16 8   rope of 24 12   rope of 32 16   rope of 64 32
    /// time                                        1.8             1.4            1.25            0.55
    /// ```
    ///
    /// Where constraints or ties are closed by the columns of the momentum, it takes some more joints.
    fn is_faster_by_columns(&self, entries: usize, is_closed: bool) -> bool {
        let SpatialRecursion { limbs, groups, .. } = &self.recursion;
        let least = |limb: &Limb| match B {
            2 if limb.is_acted_on => 48,
            3 if limb.is_acted_on => 180,
            _ => 31,
        };
        let axes = |limb: &Limb| groups[limb.groups.clone()].iter().map(|group| group.axes.len());
        let more = if is_closed { 50 } else { 0 };
        let all = limbs.iter().map(|limb| (more + least(limb)) * (1 + axes(limb).sum::<usize>()));
        10 * entries > all.sum()
    }
}

/// An elimination that is watched.
struct FactorAndKeep<'a, const B: usize> {
    factor: Factor<'a, B>,
    keep: Keep<'a, B>,
}

impl<const B: usize> InEights for FactorAndKeep<'_, B> {
    type Output = SmallestPivot;

    #[inline(always)]
    fn run<E: Eight>(mut self) -> SmallestPivot {
        self.factor.watched::<E>(&mut self.keep)
    }
}

/// The derivatives of a step by generators in space, whatever steps are solved by. They are by the configuration
/// at the start, and by the momentum of dynamic and the next position of prescribed coordinates: `2n` columns.
#[derive(Clone, Debug)]
pub(crate) enum Derivatives {
    One(Box<Eliminated<1>>),
    Two(Box<Eliminated<2>>),
    Three(Box<Eliminated<3>>),
}

/// The same of each.
macro_rules! of_any {
    ($any:expr, $own:ident => $result:expr) => {
        match $any {
            Derivatives::One($own) => $result,
            Derivatives::Two($own) => $result,
            Derivatives::Three($own) => $result,
        }
    };
}

impl Derivatives {
    pub(crate) fn new(model: &Model) -> Self {
        match model.blocks() {
            Blocks::One => Self::One(Box::new(Eliminated::new(model))),
            Blocks::Two => Self::Two(Box::new(Eliminated::new(model))),
            Blocks::Three => Self::Three(Box::new(Eliminated::new(model))),
        }
    }

    /// Whether all of them take less time than with so many entries in each triangle of the Newton matrix.
    pub(crate) fn is_faster(&self, entries: usize, is_closed: bool) -> bool {
        of_any!(self, own => own.is_faster_by_columns(entries, is_closed))
    }

    /// Factors at the second derivatives of the bodies.
    pub(crate) fn factor(
        &mut self,
        (curvature, added): (&Curvature, Added<'_>),
        own: Own<'_>,
        (inertia, time_step_s): (&[f64], f64),
    ) -> SmallestPivot {
        let vectors =
            Vectors { curvature, added, step: Step::new(time_step_s, MatrixKind::Newton) };
        of_any!(self, all => all.factor(vectors, own, inertia))
    }

    /// Makes room for all of them.
    pub(crate) fn make_room(&mut self) {
        of_any!(self, all => all.make_room());
    }

    /// Writes all of them into rows of whole blocks, for which there is room.
    pub(crate) fn write(&mut self, rows: Rows<'_>) {
        of_any!(self, all => all.write(rows));
    }

    /// The increments `x'` and momenta at the end that belong to changes `by` of the columns.
    pub(crate) fn push_forward(&mut self, by: &[f64], x: &mut [f64], momentum: &mut [f64]) {
        of_any!(self, all => all.push_forward(by, x, momentum));
    }

    /// The derivatives by the columns of `x · x' + momentum · p[k+1]'`; uses up `x`.
    pub(crate) fn pull_back(&mut self, x: &mut [f64], momentum: &[f64], by: &mut [f64]) {
        of_any!(self, all => all.pull_back(x, momentum, by));
    }
}
