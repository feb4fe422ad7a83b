//! Limits on scenes: what a scene from an unknown sender may cost.

/// Longest text of a scene, bytes.
pub const MAX_TEXT_BYTES: usize = 16 << 20;
/// Longest name, bytes.
pub const MAX_NAME_BYTES: usize = 64;
/// Most frames.
pub const MAX_FRAMES: usize = 4096;
/// Most coordinates, dynamic and prescribed together. The linearization has `(2 n)²` entries.
pub const MAX_COORDINATES: usize = 1024;
/// Most springs.
pub const MAX_SPRINGS: usize = 4096;
/// Most forces.
pub const MAX_FORCES: usize = 4096;
/// Most signals.
pub const MAX_SIGNALS: usize = 1024;
/// Most knots of splines and times of tables in all signals together.
pub const MAX_SIGNAL_POINTS: usize = 1 << 18;
/// Most inputs.
pub const MAX_INPUTS: usize = 1024;
/// Most constraint equations.
pub const MAX_CONSTRAINTS: usize = 1024;
/// Most knots of a spline.
pub const MAX_KNOTS: usize = 4096;
/// Most points of all paths together: of constraints, of springs, of forces, of inputs.
pub const MAX_PATH_POINTS: usize = 4096;
/// Most terms of all couplings together.
pub const MAX_COUPLING_TERMS: usize = 4096;
/// Most terms of all armatures together, of all springs on sums together, of all forces on sums together, and of
/// all inputs together.
pub const MAX_LINEAR_TERMS: usize = 4096;
/// Most terms of an armature of a sum.
pub const MAX_ARMATURE_TERMS: usize = 64;
/// Highest power of a coupling.
pub const MAX_POWER: usize = 16;
/// Most operating points.
pub const MAX_OPERATING_POINTS: usize = 256;
/// Most visuals of all frames together.
pub const MAX_VISUALS: usize = 1 << 14;
/// Longest path of a mesh file, bytes.
pub const MAX_FILE_BYTES: usize = 1024;
