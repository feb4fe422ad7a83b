//! The terms of the equation of motion one by one, and inverse dynamics.

use nalgebra::DMatrix;
use plantd_math::rows::padded;

use crate::continuous::{Continuous, ContinuousError, ContinuousPoint, take};
use crate::lagrangian::derivatives::Derivatives;
use crate::lagrangian::energy::{Energy, energy};
use crate::lagrangian::forces::{add_damping, input_forces};
use crate::lagrangian::instant::Instant;

/// The terms of the equation of motion of all coordinates, `n = nd + nk`, at a point:
///
/// ```text
/// M(q) a + bias(q, v) = passive(q, v) + input(q, v, inputs) + τ − Dh(q)ᵀ λ
/// ```
///
/// `τ` is what nothing in the scene exerts: on prescribed coordinates the forces of their drives, on dynamic
/// ones zero unless somebody asks for other accelerations. Rows of a coordinate are in N (lengths) or N·m
/// (angles), those of a ball joint in its own axes.
#[derive(Clone, Debug, PartialEq)]
pub struct Terms {
    /// `M`, n by n, kg, kg·m or kg·m², symmetric: bodies and armature.
    pub mass_matrix: DMatrix<f64>,
    /// Coriolis, centrifugal and gyroscopic forces, and gravity, n; no springs, no dampers.
    pub bias: Vec<f64>,
    /// The part of `bias` that is there at rest, n: the gradient of the potential energy of gravity.
    pub gravity: Vec<f64>,
    /// Forces of everything in the scene but gravity, bodies, inputs and constraints, n: springs and stops,
    /// damping, dampers, drag, friction, and the constant parts of wrenches.
    pub passive: Vec<f64>,
    /// Forces of the inputs, n; linear in them. Signals of the scene are not in it.
    pub input: Vec<f64>,
    /// `Dh`, nc by n.
    pub constraint_jacobian: DMatrix<f64>,
    /// `T = ½ vᵀ M v`, and the potential energy of gravity, springs and stops.
    pub energy: Energy,
}

/// The forces that an acceleration takes.
#[derive(Clone, Debug, PartialEq)]
pub struct InverseDynamics {
    /// `τ`, n.
    pub force: Vec<f64>,
    /// Constraint forces `λ`, nc.
    pub multipliers: Vec<f64>,
    /// `Dh a + D²h(v, v)`, nc: zero where constraints allow the acceleration. Where it is not, the forces
    /// balance the equation, but the mechanism will not move so.
    pub constraint_acceleration: Vec<f64>,
}

impl Continuous {
    /// The terms of the equation of motion; accelerations of the point are not used. Costs the second
    /// derivatives of the Lagrangian, O(n·depth), and n² numbers (allocates).
    ///
    /// # Errors
    ///
    /// [`ContinuousError::Dimension`] and [`ContinuousError::NotFinite`] name the vector,
    /// [`ContinuousError::Overflow`] if a term is not finite. A singular mass matrix is none.
    pub fn terms(&mut self, point: &ContinuousPoint) -> Result<Terms, ContinuousError> {
        self.equations.place(&self.model, point)?;
        let (model, equations) = (&*self.model, &mut self.equations);
        let (n, nd, nc) = (equations.d.coordinates(), equations.d.dynamic, equations.d.constraints);
        equations.acceleration.fill(0.0);
        let bias = equations.inertial_forces(model);
        let (q, v, inputs) = (&equations.q, &equations.v, &equations.inputs);
        let orientations = &equations.orientations;
        let mut blocks = Derivatives::<f64>::new(model);
        blocks.evaluate(model, (q, orientations), v, inputs);

        let idle = vec![0.0; inputs.len()];
        let at = |inputs| Instant {
            tree: &model.dynamics,
            poses: &blocks.poses,
            momenta: &blocks.momenta,
            q,
            velocity: v,
            inputs,
        };
        let mut passive = vec![0.0; n];
        add_damping(&model.damping, v, &vec![0.0; nd], &mut passive[..nd]);
        model.add_spring_gradient(&blocks.poses, q, &mut passive);
        let mut input = vec![0.0; n];
        input_forces(&model.coordinate_inputs, inputs, &mut input);
        if let Some(forces) = &model.forces {
            forces.add(&at(&idle), &mut passive);
            forces.for_each_input_derivative(&at(inputs), |i, k, by_u| {
                input[i] += by_u * inputs[k];
            });
        }

        let energy = energy(model, (&blocks.poses, &blocks.momenta), q, v);
        let (mut l_q, mut l_v) = (vec![0.0; n], vec![0.0; n]);
        let Derivatives { poses, momenta, l_vv, .. } = &mut blocks;
        momenta.gradient(&model.dynamics, poses, &vec![0.0; n], model.gravity, &mut l_q, &mut l_v);
        equations.closure.evaluate(model, q, orientations);
        equations.closure.differentiate(model, q);
        let terms = Terms {
            mass_matrix: DMatrix::from_row_slice(n, n, l_vv),
            bias,
            gravity: l_q.iter().map(|l_q| 0.0 - l_q).collect(),
            passive,
            input,
            constraint_jacobian: DMatrix::from_row_slice(nc, n, &equations.closure.jacobian),
            energy,
        };
        if terms.is_finite() { Ok(terms) } else { Err(ContinuousError::Overflow) }
    }

    /// The forces with which the dynamic coordinates have an acceleration, nd entries; prescribed ones have
    /// that of the point:
    ///
    /// ```text
    /// τ = M a + bias − passive − input + Dhᵀ λ
    /// ```
    ///
    /// With constraints this leaves a choice: forces along `Dhᵀ` move nothing. Of all `(τ, λ)` it is the one
    /// in which `τ_d`, the part on dynamic coordinates, is least in the metric of the mass matrix,
    /// `τ_dᵀ M_dd⁻¹ τ_d`, whatever the units of coordinates; then `Dh_d M_dd⁻¹ τ_d = 0`: it does not push
    /// against constraints. If they allow the acceleration, `λ` is that of [`Continuous::evaluate`], and `τ_d`
    /// is what the acceleration found there lacks, times the mass matrix. Of redundant constraints, the
    /// multipliers are those of least norm. Any other choice is `(τ + Dhᵀ μ, λ + μ)`.
    ///
    /// Costs [`Continuous::terms`], with constraints [`Continuous::evaluate`] too (allocates).
    ///
    /// # Errors
    ///
    /// Those of [`Continuous::terms`], and with constraints [`ContinuousError::SingularMass`].
    pub fn inverse(
        &mut self,
        point: &ContinuousPoint,
        acceleration: &[f64],
    ) -> Result<InverseDynamics, ContinuousError> {
        let terms = self.terms(point)?;
        let (nd, nc) = (self.equations.d.dynamic, self.equations.d.constraints);
        // What `terms` has changed.
        self.equations.place(&self.model, point)?;
        take("acceleration", acceleration, &mut self.equations.acceleration[..nd])?;
        let mut force = self.equations.inertial_forces(&self.model);
        for (force, (passive, input)) in
            force.iter_mut().zip(terms.passive.iter().zip(&terms.input))
        {
            *force -= passive + input;
        }
        let (mut multipliers, mut constraint_acceleration) = (Vec::new(), Vec::new());
        if nc > 0 {
            self.equations.evaluate(&self.model);
            constraint_acceleration.extend_from_slice(&self.equations.residual[nd..]);
            self.factor()?;
            let width = padded(1);
            let mut rows = vec![0.0; (nd + nc) * width];
            for (row, force) in rows.chunks_exact_mut(width).zip(&force[..nd]) {
                row[0] = *force;
            }
            self.solve_rows(&mut rows, width);
            multipliers.extend(rows[nd * width..].iter().step_by(width));
            for (row, lambda) in multipliers.iter().enumerate() {
                for (i, force) in force.iter_mut().enumerate() {
                    *force += terms.constraint_jacobian[(row, i)] * lambda;
                }
            }
        }
        let inverse = InverseDynamics { force, multipliers, constraint_acceleration };
        if inverse.is_finite() { Ok(inverse) } else { Err(ContinuousError::Overflow) }
    }
}

impl Terms {
    fn is_finite(&self) -> bool {
        let Self { mass_matrix, bias, gravity, passive, input, constraint_jacobian, energy } = self;
        let vectors = [bias, gravity, passive, input];
        let mut numbers =
            vectors.into_iter().flatten().chain(mass_matrix).chain(constraint_jacobian);
        numbers.all(|x| x.is_finite())
            && energy.kinetic_j.is_finite()
            && energy.potential_j.is_finite()
    }
}

impl InverseDynamics {
    fn is_finite(&self) -> bool {
        let Self { force, multipliers, constraint_acceleration } = self;
        force.iter().chain(multipliers).chain(constraint_acceleration).all(|x| x.is_finite())
    }
}
