#include "pipeline/decide.h"

#include <doctest/doctest.h>

#include <string>
#include <vector>

using namespace chainsplat;

namespace {

// Causes of a fit that found `evidence`, with what each leaves of it.
silhouette::CorrectionFit found(double evidence, const std::vector<silhouette::Cause>& causes) {
  silhouette::CorrectionFit out;
  out.evidence = evidence;
  out.causes = causes;
  return out;
}

std::string cause_of(const silhouette::CorrectionFit& fit, bool tabletop) {
  const silhouette::Cause* const cause = pipeline::single_cause(fit, tabletop);
  return cause ? cause->name : "";
}

silhouette::Cause clock(double left) { return {"base.time", "base.time", 1, left, 1.0}; }
silhouette::Cause length(double left) { return {"length", "grasp and length", 1, left, 1.0}; }
silhouette::Cause cameras(double left) { return {"cam2.pose", "cam2.pose", 6, left, 1.0}; }

}  // namespace

// Evidence as measured on simulated ropes (docs/design.md, 'Recognition').
TEST_CASE("a clock that explains what no right recording has is the cause on a table, where little else is wrong") {
  CHECK(cause_of(found(0.0657, {clock(0.0311), cameras(0.0630)}), true) == "base.time");           // 6 ms early
  CHECK(cause_of(found(0.0585, {clock(0.0457), length(0.0350), cameras(0.0343)}), true).empty());  // nothing is wrong
  CHECK(cause_of(found(0.1235, {clock(0.1149), length(0.1150), cameras(0.0730)}), true).empty());  // around its gripper
  // the motion of a rope that hangs tells its base's clock
  CHECK(cause_of(found(0.0657, {clock(0.0311), cameras(0.0630)}), false).empty());
}

TEST_CASE("what looks like a round end is corrected on a table from twice the evidence on") {
  CHECK(cause_of(found(0.10, {clock(0.09), length(0.03)}), false) == "length");
  CHECK(cause_of(found(0.10, {clock(0.09), length(0.03)}), true).empty());
  CHECK(cause_of(found(0.20, {clock(0.19), length(0.03)}), true) == "length");
}

TEST_CASE("nothing is the single cause that leaves a quarter, or that many numbers explain") {
  CHECK(cause_of(found(0.5, {clock(0.2), cameras(0.3)}), false).empty());
  silhouette::Cause many = cameras(0.05);
  CHECK(cause_of(found(0.5, {many}), false) == "cam2.pose");
  many.numbers = 9;
  CHECK(cause_of(found(0.5, {many}), false).empty());
}

TEST_CASE("of causes that may be mistaken for each other the likeliest is taken") {
  silhouette::Cause grasp{"grasp", "grasp and length", 3, 0.04, 5.0};
  CHECK(cause_of(found(0.5, {length(0.02), grasp}), false) == "length");
  grasp.surprise = 0.5;
  CHECK(cause_of(found(0.5, {length(0.02), grasp}), false) == "grasp");
}
