// Pinocchio: ABA with semi-implicit Euler, Runge-Kutta 4 and DOP853, and the analytic derivatives of the
// semi-implicit Euler map. Header-only, so that everything is compiled for this processor.
//
// Methods: `euler`, `rk4`, `dop853:TOLERANCE` (DT is the whole time then), `euler-ab`; `euler` and `euler-ab`
// also with `-rough`, new torques at each step. Of ball and free joints A is by turns in the body's axes.
// Points that coincide in space are constraints: `constraintDynamics` and its derivatives take ABA's place.

#include <array>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include <pinocchio/algorithm/aba-derivatives.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/constrained-dynamics-derivatives.hpp>
#include <pinocchio/algorithm/constrained-dynamics.hpp>
#include <pinocchio/algorithm/joint-configuration.hpp>
#include <pinocchio/multibody.hpp>

#include "dop853.h"  // A, B, C, E3, E5 of the pair, written by compare.py
#include "driver.h"

namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

struct Mechanism {
  pinocchio::Model model;
  std::unique_ptr<pinocchio::Data> data;
  VectorXd q0, v0, tau, rough;
  // Joints that turn as no coordinates do, and the first velocity that has a motor.
  std::vector<pinocchio::JointIndex> groups;
  int first_motor = 0;
  // Of all joints: the first numbers of configuration and velocity, and how many velocities.
  struct Place {
    int q, v, size;
  };
  std::vector<Place> places;
  std::vector<pinocchio::RigidConstraintModel> constraints;
  std::vector<pinocchio::RigidConstraintData> constraint_data;
  pinocchio::ProximalSettings settings;

  explicit Mechanism(const std::string &path) {
    std::ifstream in(path);
    int n, loops;
    double gravity;
    if (!(in >> n >> loops >> gravity)) throw std::runtime_error("no mechanism");
    model.gravity.linear() = Eigen::Vector3d(0, 0, -gravity);
    std::vector<int> sizes;
    for (int i = 0; i < n; ++i) {
      int parent, size;
      double mass;
      Eigen::Vector3d at, axis, com;
      Eigen::Quaterniond turn;
      Eigen::Matrix3d about_com;
      in >> size >> parent >> at[0] >> at[1] >> at[2];
      in >> turn.w() >> turn.x() >> turn.y() >> turn.z();
      in >> axis[0] >> axis[1] >> axis[2] >> mass >> com[0] >> com[1] >> com[2];
      for (const auto &[row, column] : {std::pair(0, 0), {1, 1}, {2, 2}, {0, 1}, {0, 2}, {1, 2}}) {
        in >> about_com(row, column);
        about_com(column, row) = about_com(row, column);
      }
      const pinocchio::SE3 place(turn.normalized().toRotationMatrix(), at);
      const std::string name = std::to_string(i);
      pinocchio::JointIndex joint;
      if (size == 6) {
        joint = model.addJoint(parent + 1, pinocchio::JointModelFreeFlyer(), place, name);
        first_motor = 6;
      } else if (size == 3) {
        joint = model.addJoint(parent + 1, pinocchio::JointModelSpherical(), place, name);
      } else if (axis[0] == 1) {
        joint = model.addJoint(parent + 1, pinocchio::JointModelRX(), place, name);
      } else if (axis[1] == 1) {
        joint = model.addJoint(parent + 1, pinocchio::JointModelRY(), place, name);
      } else if (axis[2] == 1) {
        joint = model.addJoint(parent + 1, pinocchio::JointModelRZ(), place, name);
      } else {
        const pinocchio::JointModelRevoluteUnaligned unaligned(axis);
        joint = model.addJoint(parent + 1, unaligned, place, name);
      }
      if (size > 1) groups.push_back(joint);
      sizes.push_back(size);
      model.appendBodyToJoint(joint, pinocchio::Inertia(mass, com, about_com), pinocchio::SE3::Identity());
    }
    for (int j = 1; j < model.njoints; ++j) {
      places.push_back({model.joints[j].idx_q(), model.joints[j].idx_v(), model.joints[j].nv()});
    }
    q0.resize(model.nq);
    v0.resize(model.nv);
    rough.resize(model.nv);
    int at = 0;
    for (int size : sizes) {
      if (size == 6) {
        for (int k = 0; k < 3; ++k) in >> q0[at++];
      }
      if (size == 1) {
        in >> q0[at++];
      } else {
        Eigen::Vector3d turn;
        in >> turn[0] >> turn[1] >> turn[2];
        Eigen::Quaterniond quaternion(Eigen::AngleAxisd(turn.norm(), turn.norm() > 0 ? turn.normalized() : Eigen::Vector3d::UnitX()));
        q0.segment<4>(at) = quaternion.coeffs();
        at += 4;
      }
    }
    for (double &v : v0) in >> v;
    for (double &r : rough) in >> r;
    for (int i = 0; i < loops; ++i) {
      int axes, a, b;
      Eigen::Vector3d at_a, at_b;
      in >> axes >> a >> at_a[0] >> at_a[1] >> at_a[2] >> b >> at_b[0] >> at_b[1] >> at_b[2];
      if (axes != 3) throw std::runtime_error("planar loops are not driven");
      const pinocchio::SE3 place_a(Eigen::Matrix3d::Identity(), at_a), place_b(Eigen::Matrix3d::Identity(), at_b);
      constraints.emplace_back(pinocchio::CONTACT_3D, model, a + 1, place_a, b + 1, place_b, pinocchio::LOCAL);
    }
    if (!in) throw std::runtime_error("a mechanism breaks off");
    if (first_motor == 6) {
      // The velocity of a free body is along the world's axes in the file.
      const Eigen::Quaterniond turn(q0[6], q0[3], q0[4], q0[5]);
      v0.head<3>() = turn.inverse() * v0.head<3>().eval();
    }
    tau = VectorXd::Zero(model.nv);
    data = std::make_unique<pinocchio::Data>(model);
    for (const auto &constraint : constraints) constraint_data.emplace_back(constraint.createData());
    pinocchio::initConstraintDynamics(model, *data, constraints, constraint_data);
  }
};

using Place = Mechanism::Place;

class Run {
public:
  explicit Run(Mechanism &mechanism)
      : m_(mechanism), n_(m_.model.nv), nq_(m_.model.nq), q(m_.q0), v(m_.v0), A(2 * n_, 2 * n_),
        B(2 * n_, n_ - m_.first_motor), dq_(n_, n_), dv_(n_, n_), minverse_(n_, n_), y_(nq_ + n_),
        stage_(nq_ + n_), scale_(nq_ + n_), k_(nq_ + n_, 13), by_q_(MatrixXd::Zero(n_, n_)),
        by_v_(MatrixXd::Zero(n_, n_)), step_(n_) {
    by_lambda_.fill(MatrixXd::Zero(3 * m_.constraints.size(), n_));
  }

  // The same torques as in all drivers.
  void draw(long step) {
    for (int i = m_.first_motor; i < n_; ++i) {
      m_.tau[i] = m_.rough[i] * rough_number(step, i - m_.first_motor);
    }
  }

  void euler(double h) {
    v.noalias() += h * acceleration(q, v);
    move(h);
  }

  void rk4(double h) {
    y_ << q, v;
    static const double node[3] = {0.5, 0.5, 1.0};
    stage_ = y_;
    for (int s = 0; s < 4; ++s) {
      rate(stage_, s);
      if (s < 3) stage_.noalias() = y_ + (h * node[s]) * k_.col(s);
    }
    y_.noalias() += (h / 6) * (k_.col(0) + 2 * k_.col(1) + 2 * k_.col(2) + k_.col(3));
    q = y_.head(nq_);
    v = y_.tail(n_);
  }

  void euler_and_derivatives(double h) {
    if (m_.constraints.empty()) {
      pinocchio::computeABADerivatives(m_.model, *m_.data, q, v, m_.tau, dq_, dv_, minverse_);
      minverse_.triangularView<Eigen::StrictlyLower>() =
          minverse_.transpose().triangularView<Eigen::StrictlyLower>();
    } else {
      acceleration(q, v);
      auto &[dq, dv, dtau] = by_lambda_;
      pinocchio::computeConstraintDynamicsDerivatives(
          m_.model, *m_.data, m_.constraints, m_.constraint_data, m_.settings, dq_, dv_, minverse_, dq, dv, dtau);
    }
    A.bottomLeftCorner(n_, n_) = h * dq_;
    A.bottomRightCorner(n_, n_) = h * dv_;
    A.bottomRightCorner(n_, n_).diagonal().array() += 1;
    A.topLeftCorner(n_, n_) = h * A.bottomLeftCorner(n_, n_);
    A.topLeftCorner(n_, n_).diagonal().array() += 1;
    A.topRightCorner(n_, n_) = h * A.bottomRightCorner(n_, n_);
    B.bottomRows(n_) = h * minverse_.rightCols(n_ - m_.first_motor);
    B.topRows(n_) = h * B.bottomRows(n_);
    v.noalias() += h * m_.data->ddq;
    turn_derivatives(h);
    move(h);
  }

  void dop853(double end, double tolerance) {
    double t = 0;
    struct stride stride = {0.01, false};
    y_ << q, v;
    rate(y_, 0);
    while (t < end) {
      const double h = stride.h = std::min(stride.h, end - t);
      for (int s = 1; s < 12; ++s) {
        stage_.noalias() = y_ + h * (k_.leftCols(s) * Eigen::Map<const VectorXd>(DOP853_A[s], s));
        rate(stage_, s);
      }
      stage_.noalias() = y_ + h * (k_.leftCols(12) * Eigen::Map<const VectorXd>(DOP853_B, 12));
      rate(stage_, 12);
      scale_ = tolerance * (1 + y_.cwiseAbs().cwiseMax(stage_.cwiseAbs()).array());
      const double fifth =
          ((k_ * Eigen::Map<const VectorXd>(DOP853_E5, 13)).cwiseQuotient(scale_)).squaredNorm();
      const double third =
          ((k_ * Eigen::Map<const VectorXd>(DOP853_E3, 13)).cwiseQuotient(scale_)).squaredNorm();
      const double error = dop853_error(h, third, fifth, nq_ + n_);
      if (!std::isfinite(error)) throw std::runtime_error("the motion is lost");
      if (dop853_accept(&stride, error)) {
        t += h;
        y_.swap(stage_);
        k_.col(0) = k_.col(12);
      }
    }
    q = y_.head(nq_);
    v = y_.tail(n_);
  }

private:
  void move(double h) {
    if (m_.groups.empty()) {
      q.noalias() += h * v;
      return;
    }
    step_.noalias() = h * v;
    pinocchio::integrate(m_.model, q, step_, next_);
    q.swap(next_);
  }

  // The rows of ball and free joints, by their turns at the start and by their velocities.
  void turn_derivatives(double h) {
    if (m_.groups.empty()) return;
    step_.noalias() = h * v;
    pinocchio::dIntegrate(m_.model, q, step_, by_q_, pinocchio::ARG0);
    pinocchio::dIntegrate(m_.model, q, step_, by_v_, pinocchio::ARG1);
    for (pinocchio::JointIndex joint : m_.groups) {
      const int i = m_.model.joints[joint].idx_v(), size = m_.model.joints[joint].nv();
      if (size == 6) {
        turn_rows<6>(i);
      } else {
        turn_rows<3>(i);
      }
    }
  }

  template <int size>
  void turn_rows(int i) {
    const Eigen::Matrix<double, size, size> by_v = by_v_.block<size, size>(i, i);
    A.block<size, size>(i, i).diagonal().array() -= 1;
    A.middleRows<size>(i) = by_v * A.middleRows<size>(i).eval();
    A.block<size, size>(i, i) += by_q_.block<size, size>(i, i);
    B.middleRows<size>(i) = by_v * B.middleRows<size>(i).eval();
  }

  const VectorXd &acceleration(const VectorXd &at, const VectorXd &velocity) {
    if (m_.constraints.empty()) {
      return pinocchio::aba(m_.model, *m_.data, at, velocity, m_.tau, pinocchio::Convention::WORLD);
    }
    return pinocchio::constraintDynamics(
        m_.model, *m_.data, at, velocity, m_.tau, m_.constraints, m_.constraint_data, m_.settings);
  }

  // Quaternions are integrated as four numbers, as they are, and taken with length 1.
  void rate(const VectorXd &y, int column) {
    at_ = y.head(nq_);
    velocity_ = y.tail(n_);
    double *rates = &k_(0, column);
    if (m_.groups.empty()) {
      k_.col(column).head(n_) = velocity_;
    } else {
      for (const Place &place : m_.places) {
        double *own = rates + place.q;
        const double *speed = velocity_.data() + place.v;
        if (place.size == 1) {
          *own = *speed;
          continue;
        }
        double *numbers = at_.data() + place.q + place.size - 3;
        if (place.size == 6) {
          const Eigen::Quaterniond turn = Eigen::Map<Eigen::Quaterniond>(numbers).normalized();
          Eigen::Map<Eigen::Vector3d>{own} = turn * Eigen::Vector3d(speed[0], speed[1], speed[2]);
          own += 3;
          speed += 3;
        }
        Eigen::Map<Eigen::Quaterniond> turn(numbers);
        const Eigen::Quaterniond spin(0, 0.5 * speed[0], 0.5 * speed[1], 0.5 * speed[2]);
        Eigen::Map<Eigen::Vector4d>{own} = (turn * spin).coeffs();
        turn.normalize();
      }
    }
    k_.col(column).tail(n_) = acceleration(at_, velocity_);
  }

  Mechanism &m_;
  int n_, nq_;

public:
  VectorXd q, v;
  MatrixXd A, B;

private:
  MatrixXd dq_, dv_, minverse_;
  VectorXd y_, stage_, scale_, at_, velocity_;
  MatrixXd k_, by_q_, by_v_;
  std::array<MatrixXd, 3> by_lambda_;
  VectorXd step_, next_ = VectorXd(m_.model.nq);
};

void serve(const command &c, Mechanism &mechanism) {
  std::string method = c.method;
  const bool rough = method.size() > 6 && method.substr(method.size() - 6) == "-rough";
  if (rough) method.resize(method.size() - 6);
  mechanism.tau.setZero();
  Run run(mechanism);
  const bool adaptive = method.rfind("dop853:", 0) == 0;
  const double tolerance = adaptive ? std::atof(c.method + 7) : 0;
  const double begin = cpu_seconds();
  for (long pass = 0; pass < c.passes; ++pass) {
    run.q = mechanism.q0;
    run.v = mechanism.v0;
    if (adaptive) {
      run.dop853(c.dt * double(c.steps), tolerance);
    } else if (method == "euler") {
      for (long k = 0; k < c.steps; ++k) {
        if (rough) run.draw(k);
        run.euler(c.dt);
      }
    } else if (method == "rk4") {
      for (long k = 0; k < c.steps; ++k) run.rk4(c.dt);
    } else if (method == "euler-ab") {
      for (long k = 0; k < c.steps; ++k) {
        if (rough) run.draw(k);
        run.euler_and_derivatives(c.dt);
      }
    } else {
      throw std::runtime_error("no such method");
    }
  }
  answer(cpu_seconds() - begin, run.q.data(), int(run.q.size()));
}

}  // namespace

int main() {
  std::map<std::string, std::unique_ptr<Mechanism>> mechanisms;
  command c;
  while (read_command(&c)) {
    try {
      auto &mechanism = mechanisms[c.path];
      if (!mechanism) mechanism = std::make_unique<Mechanism>(c.path);
      serve(c, *mechanism);
    } catch (const std::exception &error) {
      refuse(error.what());
    }
  }
}
