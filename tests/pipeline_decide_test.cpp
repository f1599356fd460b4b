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
  CHECK(cause_of(found(0.078, {clock(0.041), cameras(0.074)}), true) == "base.time");                 // 4 ms early
  CHECK(cause_of(found(0.047, {clock(0.039), length(0.020), cameras(0.043)}), true) == "base.time");  // 2 ms early
  CHECK(cause_of(found(0.0637, {clock(0.0630), length(0.0626), cameras(0.0289)}), true).empty());     // nothing
  CHECK(cause_of(found(0.338, {clock(0.3334), length(0.0157), cameras(0.330)}), true) == "length");   // 0.7 % short
  // the motion of a rope that hangs tells its base's clock
  CHECK(cause_of(found(0.078, {clock(0.041), cameras(0.074)}), false).empty());
}

TEST_CASE("what leaves as much as a right recording has must explain four times what it costs") {
  CHECK(cause_of(found(0.10, {clock(0.09), length(0.03)}), true) == "length");
  CHECK(cause_of(found(0.10, {clock(0.099), length(0.095)}), true).empty());
  CHECK(cause_of(found(0.07, {length(0.02)}), true).empty());
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
