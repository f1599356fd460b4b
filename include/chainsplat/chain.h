// chainsplat/chain.h - an open chain of screw joints and where its links are (mathematics.md 2.1-2.3; paper, "Chain
// kinematics").
//
// Home configuration (theta = 0): the rope lies straight from the base origin along `direction`. Link 0 is fixed to the
// base. A joint is one, two or three angles with coincident axes (bending; second bending; twist); the bodies between
// them have no mass, no length and no number. Angles are numbered base to tip, the axes of one joint side by side.
#pragma once
#include <string>
#include <vector>
#include "chainsplat/math.h"

namespace chainsplat::chain {

using math::Matrix3;
using math::MatrixX;
using math::Pose;
using math::Vector3;
using math::Vector6;
using math::VectorX;

enum class Bending { planar, spatial };

struct Chain {
  double length = 0.0;                      // m, grasp to free end
  double diameter = 0.0;                    // m
  Vector3 direction = -Vector3::UnitZ();    // d, unit, base frame
  Vector3 bending_axis = Vector3::UnitY();  // a, unit, base frame, perpendicular to d
  std::vector<Vector6> axes;                // S_k, one an angle, base frame at home (space form)
  std::vector<int> child_link;              // link moved by angle k, 1..links-1; its parent is child_link - 1
  std::vector<double> joint_arclength;      // s_j of joint j = link j, m; size links() - 1, increasing, s_1 >= 0
  // m per link, base link first, along the bending axis: a rope that is held above a table lies lower than in its
  // grasp. Of planar chains only, whose axes it does not move; empty: 0.
  std::vector<double> lift;

  int angles() const { return static_cast<int>(axes.size()); }                // n
  int links() const { return static_cast<int>(joint_arclength.size()) + 1; }  // n_l + 1, with the base link
  // Arclength range of link j: [start, end]. Link 0 is [0, s_1].
  double link_start(int link) const { return link == 0 ? 0.0 : joint_arclength[link - 1]; }
  double link_end(int link) const { return link + 1 == links() ? length : joint_arclength[link]; }
  double link_lift(int link) const { return lift.empty() ? 0.0 : lift[link]; }
  int last_angle(int link) const;  // k(j): index of the last angle that moves `link`, -1 for link 0
};

// `joints` joints at s_j = (j - 1) L / joints (mathematics.md 2.1 [D]). Axes per joint: a; a, b = d x a; with twist
// also d. `first_joint` moves the first one: s_j = first_joint + (j-1)(L - first_joint)/joints.
Chain make_chain(double length, double diameter, const Vector3& direction, const Vector3& bending_axis, int joints,
                 Bending bending, bool twist, double first_joint = 0.0);

// E_j for j = 0..n_l: world pose that carries home coordinates (base frame) of link j to the world, lift included. E_0
// = base. mathematics.md 2.2.
std::vector<Pose> link_motions(const Chain& chain, const VectorX& theta, const Pose& base);

// s_k, world-frame screw axes at theta, 6 x n (columns). mathematics.md 2.3.
MatrixX world_axes(const Chain& chain, const VectorX& theta, const Pose& base);

// World position of the home point X (base frame) of link j, and its 3 x n Jacobian with respect to theta (base fixed)
// from the world axes: column k is s_k^w x x + s_k^v for k <= last_angle(link), else 0.
MatrixX point_jacobian(const Chain& chain, const MatrixX& world_axes, int link, const Vector3& world_point);

// A point fixed to a link, `home` its place at theta = 0 in the base frame, m.
struct MaterialPoint {
  int link = 0;
  Vector3 home = Vector3::Zero();
};
MaterialPoint centerline_point(const Chain& chain, double arclength);
// What tells a shape: every link's end, and its middle before it if asked for; where the rope can twist, then also a
// point per link on its surface at the end.
std::vector<MaterialPoint> shape_points(const Chain& chain, bool middles);
// point_jacobian() of each, 3 x n. `axes` and `motions` are those of one state.
std::vector<MatrixX> point_jacobians(const Chain& chain, const MatrixX& world_axes, const std::vector<Pose>& motions,
                                     const std::vector<MaterialPoint>& points);
// The same of the ends of links 1.. : the joints after the first and the free end.
std::vector<MatrixX> link_end_jacobians(const Chain& chain, const MatrixX& world_axes,
                                        const std::vector<Pose>& motions);
std::vector<MatrixX> link_end_jacobians(const Chain& chain, const VectorX& theta, const Pose& base);
// Sum of weight J^T J (weight 1 where none are given), n x n: the squared displacement of points by a change of the
// angles, and the covariance of the torques that random forces there cause, alike in all directions.
MatrixX displacement_metric(const std::vector<MatrixX>& jacobians, const VectorX& weights = {});

// Does this angle turn the rope about itself instead of bending it? The axes of a joint are perpendicular, so anything
// between 0 and 1 tells them apart.
bool is_twist(const Chain& chain, int angle);
bool has_twist(const Chain& chain);
// Does the rope leave a plane: do its joints turn about more than one axis? A planar chain has one angle per joint.
bool bends_in_space(const Chain& chain);
// A deviation of the difference of neighboring joints' angles, given for eight joints, for this chain: a rope's
// curvature changes along it whatever the number of its joints, so that the difference goes with the square of a link's
// length.
double neighbor_difference(const Chain& chain, double of_eight);
// Information (n x n, 1/rad^2) that a rope's curvature changes little along it: neighboring angles about one axis differ
// by this deviation, rad. The first joint of a planar chain is at the clamp and stands for half a link (bent_length), but
// for the half that bends most, so that it is held near 0.65 of the second (of 16). In space it counts as the others,
// because it also takes up how the gripper holds the rope, which is an unknown of planar chains (mathematics.md 6.1).
MatrixX curvature_information(const Chain& chain, double deviation);

// What straight links and a tube of constant width cannot follow: the variance, m^2 per coordinate, of the position of
// every link's end (links 1..), and the covariance of the angles that follows from it, rad^2, n x n (mathematics.md
// 6.11). It belongs to every covariance that is told, and to none that weights measurements by their noise.
std::vector<double> shape_variances(const Chain& chain, const VectorX& theta);
MatrixX shape_covariance(const Chain& chain, const std::vector<double>& variances, const VectorX& theta);
// The covariance of independent errors of all angles, alike at every joint, by which the links' ends move by
// `deviation`, m, RMS over the rope: rad^2, n x n (mathematics.md 6.11).
MatrixX bend_covariance(const Chain& chain, double deviation, const VectorX& theta);

// Link that carries the material point at `arclength` (a joint belongs to the link it starts).
int link_at(const Chain& chain, double arclength);

// World points of the centerline at the given arclengths (straight links; mathematics.md 2.2), 3 x count.
MatrixX centerline(const Chain& chain, const std::vector<Pose>& motions, const std::vector<double>& arclengths);
// Length of rope whose bending joint j = 1.. stands for, m: from the middle of the link before it to the middle of its
// own (mathematics.md 3.2). A first joint on the clamp has only the half behind it; where a base link reaches from the
// clamp to the first joint, that joint also stands for all of it. Without tension a rod's joint has EI over this length
// (dynamics/rod.h).
double bent_length(const Chain& chain, int joint);
// The nodes: grasp, every joint, free end, 3 x (n_l + 2). Where s_1 = 0 the first two coincide.
MatrixX nodes(const Chain& chain, const std::vector<Pose>& motions);
// `count` equally spaced arclengths from 0 to the length.
std::vector<double> equal_arclengths(const Chain& chain, int count);

// dl/dtheta from dl/d(link motion): g is 6 x links, world twists about the world origin (mathematics.md 2.3): suffix
// sums.
VectorX theta_gradient(const Chain& chain, const MatrixX& world_axes, const MatrixX& link_twist_gradient);

// Angles along time. `thetadot` and `covariance` are empty or as long as `theta`.
struct States {
  std::vector<double> time;                  // s
  std::vector<VectorX> theta;                // rad, n each
  std::vector<VectorX> thetadot;             // rad/s
  std::vector<MatrixX> covariance;           // rad^2, n x n, of theta
  std::vector<VectorX> internal_state = {};  // of ropes that have one, as in dynamics::InitialState
  // How far the material has turned about each link's axis, rad, links() values each: a rope that rolls over a table
  // carries its texture along. Empty: not at all.
  std::vector<VectorX> roll = {};
};
// theta at any time: cubic (Catmull-Rom on the given times), clamped outside by linear extrapolation of at most one
// interval.
VectorX interpolate(const States& states, double time);
// The roll at any time: linear, outside of the given times that of the nearest; empty where there is none.
VectorX roll_at(const States& states, double time);

// link_motions() of the material, turned about each link's axis by `roll` (links() values, rad; empty: none): what
// carries Gaussians (mathematics.md 2.2).
std::vector<Pose> material_motions(const Chain& chain, const VectorX& theta, const VectorX& roll, const Pose& base);
std::vector<Pose> material_motions(const Chain& chain, const States& states, double time, const Pose& base);

}  // namespace chainsplat::chain
