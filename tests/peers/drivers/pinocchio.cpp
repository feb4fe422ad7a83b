// Pinocchio: ABA with semi-implicit Euler, Runge-Kutta 4 and DOP853, and the analytic derivatives of the
// semi-implicit Euler map. Header-only, so that everything is compiled for this processor.
//
// Methods: `euler`, `rk4`, `dop853:TOLERANCE` (DT is the whole time then), `euler-ab`.

#include <cmath>
#include <cstdlib>
#include <fstream>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>

#include <pinocchio/algorithm/aba-derivatives.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/multibody.hpp>

#include "dop853.h"  // A, B, C, E3, E5 of the pair, written by compare.py
#include "driver.h"

namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

struct Mechanism {
  pinocchio::Model model;
  std::unique_ptr<pinocchio::Data> data;
  VectorXd q0, v0, tau;

  explicit Mechanism(const std::string &path) {
    std::ifstream in(path);
    int n, loops;
    double gravity;
    if (!(in >> n >> loops >> gravity)) throw std::runtime_error("no mechanism");
    if (loops != 0) throw std::runtime_error("loops are not driven");
    model.gravity.linear() = Eigen::Vector3d(0, 0, -gravity);
    for (int i = 0; i < n; ++i) {
      int parent;
      double mass;
      Eigen::Vector3d at, axis, com, inertia;
      in >> parent >> at[0] >> at[1] >> at[2] >> axis[0] >> axis[1] >> axis[2] >> mass;
      in >> com[0] >> com[1] >> com[2] >> inertia[0] >> inertia[1] >> inertia[2];
      const pinocchio::SE3 place(Eigen::Matrix3d::Identity(), at);
      const std::string name = std::to_string(i);
      pinocchio::JointIndex joint;
      if (axis[0] == 1) {
        joint = model.addJoint(parent + 1, pinocchio::JointModelRX(), place, name);
      } else if (axis[1] == 1) {
        joint = model.addJoint(parent + 1, pinocchio::JointModelRY(), place, name);
      } else {
        joint = model.addJoint(parent + 1, pinocchio::JointModelRZ(), place, name);
      }
      const Eigen::Matrix3d about_com = inertia.asDiagonal();
      model.appendBodyToJoint(joint, pinocchio::Inertia(mass, com, about_com), pinocchio::SE3::Identity());
    }
    q0.resize(n);
    v0.resize(n);
    for (double &q : q0) in >> q;
    for (double &v : v0) in >> v;
    if (!in) throw std::runtime_error("a mechanism breaks off");
    tau = VectorXd::Zero(n);
    data = std::make_unique<pinocchio::Data>(model);
  }
};

class Run {
public:
  explicit Run(Mechanism &mechanism)
      : m_(mechanism), n_(int(m_.q0.size())), q(m_.q0), v(m_.v0), A(2 * n_, 2 * n_), B(2 * n_, n_),
        dq_(n_, n_), dv_(n_, n_), minverse_(n_, n_), y_(2 * n_), stage_(2 * n_), scale_(2 * n_),
        k_(2 * n_, 13) {}

  void euler(double h) {
    v.noalias() += h * acceleration(q, v);
    q.noalias() += h * v;
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
    q = y_.head(n_);
    v = y_.tail(n_);
  }

  void euler_and_derivatives(double h) {
    pinocchio::computeABADerivatives(m_.model, *m_.data, q, v, m_.tau, dq_, dv_, minverse_);
    minverse_.triangularView<Eigen::StrictlyLower>() =
        minverse_.transpose().triangularView<Eigen::StrictlyLower>();
    A.bottomLeftCorner(n_, n_) = h * dq_;
    A.bottomRightCorner(n_, n_) = h * dv_;
    A.bottomRightCorner(n_, n_).diagonal().array() += 1;
    A.topLeftCorner(n_, n_) = h * A.bottomLeftCorner(n_, n_);
    A.topLeftCorner(n_, n_).diagonal().array() += 1;
    A.topRightCorner(n_, n_) = h * A.bottomRightCorner(n_, n_);
    B.bottomRows(n_) = h * minverse_;
    B.topRows(n_) = h * B.bottomRows(n_);
    v.noalias() += h * m_.data->ddq;
    q.noalias() += h * v;
  }

  // Hairer, Nørsett, Wanner: Solving Ordinary Differential Equations I, II.5.
  void dop853(double end, double tolerance) {
    double t = 0, h = 0.01;
    y_ << q, v;
    rate(y_, 0);
    bool rejected = false;
    while (t < end) {
      h = std::min(h, end - t);
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
      const double sum = fifth + 0.01 * third;
      const double error = sum == 0 ? 0 : h * fifth / std::sqrt(sum * double(2 * n_));
      if (!std::isfinite(error)) throw std::runtime_error("the motion is lost");
      double factor = error == 0 ? 10 : 0.9 * std::pow(error, -1.0 / 8);
      if (error < 1) {
        t += h;
        y_.swap(stage_);
        k_.col(0) = k_.col(12);
        h *= std::min(rejected ? 1.0 : 10.0, factor);
        rejected = false;
      } else {
        h *= std::max(0.2, factor);
        rejected = true;
      }
    }
    q = y_.head(n_);
    v = y_.tail(n_);
  }

private:
  const VectorXd &acceleration(const VectorXd &at, const VectorXd &velocity) {
    return pinocchio::aba(m_.model, *m_.data, at, velocity, m_.tau, pinocchio::Convention::WORLD);
  }

  void rate(const VectorXd &y, int column) {
    at_ = y.head(n_);
    velocity_ = y.tail(n_);
    k_.col(column).head(n_) = velocity_;
    k_.col(column).tail(n_) = acceleration(at_, velocity_);
  }

  Mechanism &m_;
  int n_;

public:
  VectorXd q, v;
  MatrixXd A, B;

private:
  MatrixXd dq_, dv_, minverse_;
  VectorXd y_, stage_, scale_, at_, velocity_;
  MatrixXd k_;
};

void serve(const command &c, Mechanism &mechanism) {
  const std::string method = c.method;
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
      for (long k = 0; k < c.steps; ++k) run.euler(c.dt);
    } else if (method == "rk4") {
      for (long k = 0; k < c.steps; ++k) run.rk4(c.dt);
    } else if (method == "euler-ab") {
      for (long k = 0; k < c.steps; ++k) run.euler_and_derivatives(c.dt);
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
