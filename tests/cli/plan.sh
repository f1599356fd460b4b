#!/bin/bash
# plan on two small twins made by hand: what it writes, and one clear line for every wrong request. No Vulkan device.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
free=$source_dir/tests/data/planning/free
table=$source_dir/tests/data/planning/table
out=$work/plan

refused() {  # pattern run options...
  local pattern=$1 run=$2
  shift 2
  expect_error 2 "$pattern" plan "$run" -o "$out" "$@"
  [ -e "$out" ] && fail "$pattern: something was written" && rm -rf "$out"
}
planned() {  # run options...
  rm -rf "$out"
  run plan "$@" -o "$out" --horizon 1 --starts 8
  expect_code 0 "plan $*"
  for file in base.tum base.csv states.csv plan.json picture.svg; do
    [ -s "$out/$file" ] || fail "plan $*: no $file"
  done
}
expect_plan() {  # pattern
  grep -Eq -- "$1" "$out/plan.json" || fail "plan.json does not match '$1'"
}
expect_warning() {  # pattern
  grep -Eq -- "^chainsplat: warning: .*$1" "$work/stderr" || fail "no warning matches '$1'"
}

# targets
refused 'target.*not a finite' "$free" --target nan,0,0.3
refused 'target.*not a finite' "$free" --target 0.1,inf,0.3
refused 'target.*3 numbers' "$free" --target 0.1,0.3
refused 'target.*3 numbers' "$free" --target 0.1,x,0.3
refused 'target.*3 numbers' "$free" --target 0.1,0,0.3,
refused 'target.*under the table' "$table" --target 0.1,0.1,-0.02
refused 'target.*seed' "$free" --target random:x
refused 'hit' "$free" --target random:1 --hit middle
# limits
for limit in velocity acceleration jerk stroke yaw-velocity yaw-acceleration yaw-jerk turn; do
  refused "${limit//-/ } limit.*above 0" "$free" --target random:1 "--$limit" -1
done
refused 'velocity limit.*nan' "$free" --target random:1 --velocity nan
refused 'terminal.*stroke' "$free" --target random:1 --terminal 0.5 --stroke 0.4
refused 'terminal.*velocity limit' "$free" --target random:1 --terminal 0.5 --horizon 0.3
refused 'terminal.*acceleration limit' "$free" --target random:1 --terminal 0.5 --horizon 0.4
refused 'terminal.*jerk limit' "$free" --target random:1 --terminal 0.5 --horizon 1 --jerk 10
refused 'terminal.*each of the 2 axes' "$free" --target random:1 --terminal 0.1 --axes x,z
refused 'horizon' "$free" --target random:1 --horizon 0
refused 'tolerance' "$free" --target random:1 --tolerance 0
refused 'axes.*no axis' "$free" --target random:1 --axes x,w
refused 'axes.*twice' "$free" --target random:1 --axes x,x
refused 'axes.*leaves the table' "$table" --target random:1 --axes x,z
# obstacles
refused 'keep-out-sphere.*no sphere' "$free" --target random:1 --keep-out-sphere 0,0,0.5,-0.1
refused 'keep-out-sphere.*4 numbers' "$free" --target random:1 --keep-out-sphere 0,0,0.5
refused 'keep-out-box.*no box' "$free" --target random:1 --keep-out-box 0.1,0,0,0,1,1
refused 'keep-out-sphere.*at the start' "$free" --target random:1 --keep-out-sphere 0,0,0.4,0.05
# files and feedback
refused 'twin.json|nothing' "$work/nothing" --target random:1
refused 'nothing.csv' "$free" --target random:1 --initial "$work/nothing.csv"
refused 'no single camera' "$free" --target random:1 --state-from "$source_dir/assets/demo_free_30"
refused 'cam9' "$free" --target random:1 --state-from "$source_dir/assets/demo_free_30:cam9"
refused 'simulate' "$free" --target random:1 --mpc
echo '{' >"$work/broken.json"
refused 'broken.json.*JSON' "$free" --target random:1 --simulate "$work/broken.json"
sed 's/"damping": [0-9.e-]*/"damping": -1/' "$free/twin.json" >"$work/negative.json"
refused 'negative.json.*damping' "$free" --target random:1 --simulate "$work/negative.json"
mkdir "$out" && touch "$out/mine"
expect_error 2 'plan' plan "$free" --target random:1 -o "$out"
rm -rf "$out"

# what is written, on both kinds of twin
planned "$free" --target random:1
expect_plan '"reached": true'
head -1 "$out/base.csv" | grep -q '^time,x,y,z,vx,vy,vz,ax,ay,az,yaw' || fail 'base.csv has another first line'
[ "$(grep -vc '^#' "$out/base.tum")" -eq 101 ] || fail 'base.tum has not 100 rows a second'
planned "$table" --target random:2 --rate 10
expect_plan '"reached": true'
expect_plan '"hit": "rope"'
planned "$free" --target 0,0,0.4 --hit rope
expect_plan '"miss_arclength": 0\.1'
# two targets in sequence past a sphere and a box, ending where it began
planned "$free" --target 0.1,0,0.27 --target -0.1,0,0.3 --axes x,z --terminal 0,0 --keep-out-sphere 0.3,0,0.3,0.03 \
  --keep-out-box -0.4,-0.1,0.2,-0.3,0.1,0.3
expect_plan '"hits"'
# out of reach: a warning first, the nearest motion all the same, and exit code 1
rm -rf "$out"
run plan "$free" --target 1.5,0,0.3 -o "$out" --horizon 1 --starts 8
expect_code 1 'out of reach'
head -1 "$work/stderr" | grep -q 'warning: .*beyond what rope length' || fail 'out of reach: not said first'
tail -1 "$work/stderr" | grep -Eq '^chainsplat: error: --target: cannot be reached: .*; .*nearest motion is in' ||
  fail 'out of reach: another last line'
expect_warning 'beyond what rope length'
expect_plan '"reached": false'
expect_plan '"reason"'
# parameters drawn from the covariance
planned "$free" --target random:1 --samples 3
expect_plan '"expected_miss"'
# feedback against the same chain
planned "$table" --target random:2 --simulate "$table/twin.json" --mpc
expect_plan '"with_feedback"'
# without identified dynamics: a warning that says what is missing
cp -r "$free" "$work/bare"
sed -i '/"\(mass\|center_of_mass\|viscous_friction\|coulomb_friction\|stiffness\|damping\|rest_angle\)":/d' "$work/bare/twin.json"
sed -i -z 's/,\(\n *}\)/\1/g' "$work/bare/twin.json"
planned "$work/bare" --target 0.05,0,0.28
expect_warning 'not identified; mass, stiffness, damping and friction'
# start from one image of a capture of another rope of the same length
planned "$free" --target random:1 --state-from "$source_dir/assets/demo_free_30:cam0"
grep -q 'starts as cam0 sees it' "$work/stderr" || fail 'does not say what the image gave'
finish
