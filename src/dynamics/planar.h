// Private to dynamics: the equations of motion of a chain that bends about one direction, several times faster.
//
// Everything happens in the base frame, in the plane of bending, about the base origin: x = d, y = a x d, z = a. There
// the formulas of spatial.h hold with twists (turn rate, velocity) and wrenches (moment, force) of three numbers each.
// What a base that also moves and turns out of the plane adds are fields that are fixed to the base:
//   acceleration  o + X r,  o = (w_y v_z, -w_x v_z),  X = [-w_y^2, w_x w_y; w_x w_y, -w_x^2]
//   velocity      z part v_z + g r,  g = (-w_y, w_x), which friction feels
//   the table's normal
// A unit turn of angle k is seen from the outer links as these fields turned back about joint k. X needs the second
// moments of the links, not only their inertia about z.
#pragma once
#include <vector>

#include "engine.h"

namespace chainsplat::dynamics {

// One axis per joint, all along the bending axis.
bool is_planar(const chain::Chain& chain);

class PlanarEngine : public Engine {
 public:
  explicit PlanarEngine(const Model& model);
  void place(const trajectory::BaseMotion& base, const VectorX& theta, const VectorX& thetadot, bool slopes) override;
  void linearize(const Vector6& base_jerk) override;
  void base_slopes(BaseSlopes& slopes) const override;
  void unknown_forces(std::span<const Tangent> unknowns, MatrixX& forces) override;

  struct Planar {  // twist or wrench
    double turn = 0.0, x = 0.0, y = 0.0;
  };

 private:
  struct Body {                                   // about the base origin; composite ones: of all outer links
    double mass, moment_x, moment_y, xx, xy, yy;  // second moments; about z: xx + yy
  };
  struct Slope {          // minus dW/d(...), as it enters the body force
    double e[3][3] = {};  // by the link's twist, with the inertial part
    Planar turn_back[3];  // by the normal, turned back by a unit about x, y, z
    Planar z, zx, zy;     // by the z velocity 1, x, y
  };
  struct Unit {  // wrenches of a unit of a parameter, as they enter the body force
    Planar mass, viscous, coulomb, air_linear, air_quadratic;
  };
  void friction(int link, bool slopes);
  void air_friction(int link, bool slopes);
  void table_friction(int link, bool slopes);
  Planar inertial(const Body& body, const Planar& v, const Planar& a) const;
  Planar field(const Body& body, double xx, double xy, double yy) const;  // of the acceleration X r
  // What a twist of all links outside of joint j does there, as an acceleration and as a velocity.
  Planar inertia_row_of(int j) const;
  Planar velocity_row_of(int j) const;

  Matrix3 plane_;                   // columns x, y, z in the base frame
  Vector3 spin_, slide_;            // w and v of the base
  Vector3 spin_rate_, slide_rate_;  // their derivatives, component by component, without gravity
  Vector3 normal_here_;             // the table's, in the plane's frame
  Vector3 gravity_here_;
  double tidal_xx_ = 0.0, tidal_xy_ = 0.0, tidal_yy_ = 0.0;
  std::vector<double> cos_, sin_, first_moment_, second_, across_;  // a link
  std::vector<double> px_, py_;                                     // joints
  std::vector<Planar> inner_v_, inner_a_, v_, a_, turn_k_, wrench_, force_;
  std::vector<Body> body_, composite_;
  std::vector<Slope> slope_sum_;
  std::vector<Planar> roll_slope_;  // of the friction across a link, by its twist
  std::vector<Unit> units_;
  Planar unit_tip_planar_, unit_tip_length_;
  std::vector<double> lift_;  // a joint: the z velocity's change at the base origin where the fields turn back about it
};

}  // namespace chainsplat::dynamics
