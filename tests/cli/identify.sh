#!/bin/bash
# new, rollout of a known rod, identify from markers and from several runs, and what they refuse. No Vulkan device.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent

expect_error 2 'mass' new -o "$work/bad" --length 0.3 --mass 0
expect_error 2 'mass' new -o "$work/bad" --length 0.3 --mass=-1
expect_error 2 'length' new -o "$work/bad" --length 0
expect_error 2 "tip-length: says nothing without a payload's mass" new -o "$work/bad" --length 0.3 --mass 0.06 --tip-length 0.05
expect_error 2 'tip-length: -1 m is no length' new -o "$work/bad" --length 0.3 --mass 0.06 --tip-mass 0.02 --tip-length -1
expect_error 2 'tip-length: nan m is no length' new -o "$work/bad" --length 0.3 --mass 0.06 --tip-mass 0.02 --tip-length nan
expect_error 2 "length: 'nan' is not a number above 0" new -o "$work/bad" --length nan
expect_error 2 'bending-axis' new -o "$work/bad" --length 0.3 --bending-axis 0,0,1
expect_error 2 'bending-stiffness: .*mass' new -o "$work/bad" --length 0.3 --bending-stiffness 1e-3
expect_error 2 'table: .*direction' new -o "$work/bad" --length 0.3 --table 0,0,0
expect_error 2 'friction: .*table' new -o "$work/bad" --length 0.3 --friction 0.3
expect_error 2 'friction: .*bending-stiffness' new -o "$work/bad" --length 0.3 --table 0,0,0 --direction 1,0,0 --friction 0.3
expect_error 2 'bending-stiffness: .*friction' new -o "$work/bad" --length 0.3 --mass 0.06 --bending-stiffness 1e-3 \
  --table 0,0,0 --direction 1,0,0
expect_error 2 'table' new -o "$work/bad" --length 0.3 --table 0,0,inf --direction 1,0,0
[ -e "$work/bad" ] && fail 'new: a refused twin was written'

# a known rod, moved along x, or on a table along y, seen at three points
base() {  # amplitude in m, axis
  awk -v a="$1" -v axis="$2" 'BEGIN { for (k = 0; k <= 300; ++k) { t = k / 100; e = 1 - exp(-(t / 0.4) ^ 3)
    at = a * e * sin(2 * 3.14159265 * 0.7 * t)
    printf "%.2f %.9f %.9f %s 0 0 0 1\n", t, axis == "x" ? at : 0, axis == "y" ? at : 0, axis == "x" ? 0.5 : 0.01 } }'
}
recording() {  # rod, amplitude, name, axis (x): name.tum and name.csv
  base "$2" "${4:-x}" >"$work/$3.tum"
  run rollout "$work/$1" --base "$work/$3.tum" --rate 50 -o "$work/states.csv" --centerline "$work/line.csv"
  expect_code 0 "rollout of $1"
  # nodes of four joints: grasp, joints 1-4 (the first at the grasp), end
  awk -F, -v base="$work/$3.tum" 'BEGIN { while ((getline line < base) > 0) { split(line, b, " "); at[b[1] + 0] = b[2] "," b[3] "," b[4] }
      print "# marker a 0.15\n# marker b 0.225\n# marker c 0.3"
      print "time,bx,by,bz,bqw,bqx,bqy,bqz,a_x,a_y,a_z,b_x,b_y,b_z,c_x,c_y,c_z" }
    NR > 1 { t = sprintf("%.2f", $1) + 0
      printf "%.2f,%s,1,0,0,0,%s,%s,%s,%s,%s,%s,%s,%s,%s\n", t, at[t], $11, $12, $13, $14, $15, $16, $17, $18, $19 }
  ' "$work/line.csv" >"$work/$3.csv"
}
rod() {  # name, EI
  run new -o "$work/$1" --length 0.3 --joints 4 --bending planar --mass 0.06 --bending-stiffness "$2" --retardation 0.08
  expect_code 0 "new $1"
}
rod rod 4.5e-4
rod stiff 4.5e-3
recording rod 0.1 one
recording rod 0.15 two
recording stiff 0.1 other

run new -o "$work/twin" --length 0.3 --joints 4 --bending planar --mass 0.06
expect_code 0 'new'
expect_error 2 'identif' rollout "$work/twin" --base "$work/one.tum" -o "$work/states.csv"
run identify "$work/twin" --markers "$work/one.csv" "$work/two.csv"
expect_code 0 'identify --markers'
# EI over the length that one joint stands for: 4.5e-4 / 0.075 = 0.006; three markers and the priors tell it within a
# quarter (the standard error is of that size)
awk '$1 == "log_stiffness" { exit !(exp($2) > 0.0045 && exp($2) < 0.0075) }' "$work/stdout" ||
  fail "identify --markers: stiffness $(awk '$1 == "log_stiffness" { print exp($2) }' "$work/stdout") instead of 0.006"
expect_output 'The data tell less than the priors' 'identify --markers'
run identify "$work/twin" --markers "$work/one.csv" --json
expect_code 0 'identify --json'
expect_output '"weak"' 'identify --json'
expect_error 2 '(one|other).csv: is of another rope' identify "$work/twin" --markers "$work/one.csv" "$work/other.csv"

# a rod on a table, moved across: three markers tell its friction
table=(--length 0.3 --joints 4 --mass 0.06 --table 0,0,0 --direction 1,0,0)
run new -o "$work/table_rod" "${table[@]}" --bending-stiffness 4.5e-4 --retardation 0.08 --friction 0.25
expect_code 0 'new --table --bending-stiffness'
recording table_rod 0.1 table y
run new -o "$work/table_twin" "${table[@]}"
expect_code 0 'new --table'
run identify "$work/table_twin" --markers "$work/table.csv"
expect_code 0 'identify --markers on a table'
python3 - "$work/table_twin/twin.json" <<'PYTHON' || fail 'identify --markers on a table: another friction or stiffness than the rod has'
import json, sys
twin = json.load(open(sys.argv[1]))
for name, truth in ("friction_coefficient", 0.25), ("bending_stiffness", 4.5e-4):
    found = twin["properties"][name]
    print(name, found)
    assert abs(found["value"] - truth) < 3 * found["sigma"] and 0 < found["sigma"] < truth, (name, found)
assert twin["chain"]["scenario"] == "tabletop" and "air_quadratic" not in twin["properties"]
PYTHON

# what was not in its recording is warned of, and what the gripper must hold is the rope's weight in the mean
run rollout "$work/twin" --base "$work/one.tum" -o "$work/states.csv" --wrench "$work/wrench.csv"
expect_code 0 'rollout --wrench'
grep -q 'identified in' "$work/stderr" && fail 'rollout: the motion of the recording is said to be beyond it'
awk -F, 'NR == 1 && $0 != "time,fx,fy,fz,mx,my,mz" { exit 1 }
  NR > 1 { z += $4; n++ } END { exit !(n > 50 && z / n > 0.95 * 0.06 * 9.81 && z / n < 1.05 * 0.06 * 9.81) }' "$work/wrench.csv" ||
  fail 'rollout --wrench: not the weight of 60 g in the mean'
awk '/^#/ { next } { $1 /= 3; print }' "$work/one.tum" >"$work/fast.tum"
run rollout "$work/twin" --base "$work/fast.tum" -o "$work/states.csv"
expect_code 0 'rollout of a fast motion'
grep -q 'fast.tum: the .* times what the twin was identified in' "$work/stderr" || fail 'rollout: no warning of a motion three times as fast'
expect_error 2 'folder does not exist' rollout "$work/twin" --base "$work/one.tum" -o "$work/s.csv" --wrench "$work/no/such/folder.csv"

# several runs: recognized states stand for themselves
for name in one two other; do
  run new -o "$work/run_$name" --length 0.3 --joints 4 --bending planar --mass 0.06
  run identify "$work/run_$name" --markers "$work/$name.csv" --shape-only
  expect_code 0 'identify --shape-only'
done
grep -q '"stiffness"' "$work/run_one/twin.json" && fail 'identify --shape-only: has dynamics'
run identify "$work/run_one" "$work/run_two"
expect_code 0 'identify RUN RUN'
joints() { sed -n '/"joints": \[/,/"links": \[/p' "$work/$1/twin.json"; }
[ "$(joints run_one)" = "$(joints run_two)" ] || fail 'identify RUN RUN: the parameters differ'
cmp -s "$work/run_one/rollout.csv" "$work/run_two/rollout.csv" && fail 'identify RUN RUN: the rollouts do not differ'
cp -r "$work/run_one" "$work/kept"
expect_error 2 'another rope' identify "$work/run_one" "$work/run_other"
cmp -s "$work/kept/twin.json" "$work/run_one/twin.json" || fail 'identify RUN RUN: a refused twin was written'
expect_error 2 'named twice' identify "$work/run_one" "$work/run_one/"
run new -o "$work/longer" --length 0.4 --joints 4 --bending planar --mass 0.06
run identify "$work/longer" --markers "$work/one.csv" --shape-only
expect_error 2 'another rope.*0\.4' identify "$work/run_one" "$work/longer"
run new -o "$work/finer" --length 0.3 --joints 5 --bending planar --mass 0.06
run identify "$work/finer" --markers "$work/one.csv" --shape-only
expect_error 2 '5 joints' identify "$work/run_one" "$work/finer"
expect_error 2 'markers: goes with one RUN' identify "$work/run_one" "$work/run_two" --markers "$work/one.csv"

# marker files that are wrong in one way each
refused() { expect_error 2 "$1" identify "$work/twin" --markers "$work/wrong.csv"; }
before=$(cat "$work/twin/twin.json")
sed '10{h;d};11{G}' "$work/one.csv" >"$work/wrong.csv"
refused 'wrong\.csv:[0-9]+: the times do not increase'
sed '10s/,[^,]*$//' "$work/one.csv" >"$work/wrong.csv"
refused 'wrong\.csv:10: 16 columns instead of 17'
sed '10s/,[^,]*$/,abc/' "$work/one.csv" >"$work/wrong.csv"
refused 'wrong\.csv:10: column 17 is not a finite number'
sed 's/,c_y,c_z$/,c_y,c_z,c_z/; /^[0-9]/s/$/,0/' "$work/one.csv" >"$work/wrong.csv"
refused "wrong\.csv:4: there are two columns 'c_z'"
sed '/^# marker/d' "$work/one.csv" >"$work/wrong.csv"
refused 'no marker is named'
sed 's/marker c 0.3/marker c 0.5/' "$work/one.csv" >"$work/wrong.csv"
refused 'arclength 0\.5 .*another rope'
sed 's/marker c 0.3/marker c 0.2/' "$work/one.csv" >"$work/wrong.csv"
refused 'from the grasp.*another rope'
head -6 "$work/one.csv" >"$work/wrong.csv"
refused 'fewer than 3 rows'
sed '10s/,[^,]*$/,1e308/' "$work/one.csv" >"$work/wrong.csv"
refused 'at .* s marker 3 is .* m from the grasp'
sed '10s/^[^,]*/1e300/;11,$d' "$work/one.csv" >"$work/wrong.csv"
refused '; '
[ "$before" = "$(cat "$work/twin/twin.json")" ] || fail 'a refused file changed the twin'

# run folders that are wrong in one way each: one clear line, and the twin is left as it is
run identify "$work/run_one"
expect_code 0 'identify'
damaged() { rm -rf "$work/damaged"; cp -r "$work/run_one" "$work/damaged"; }
damaged; sed -i 's/"mass": "0.06"/"mass": "abc"/' "$work/damaged/twin.json"
expect_error 2 "twin\.json: provenance\.options\.mass: 'abc' is not a positive number" identify "$work/damaged"
damaged; awk -F, 'NR == 4 { sub($2, "-1e-4") } { print }' "$work/run_one/covariance.csv" >"$work/damaged/covariance.csv"
expect_error 2 'covariance\.csv:4: its numbers are no covariance' identify "$work/damaged"
damaged; head -20 "$work/run_one/base.tum" >"$work/damaged/base.tum"
expect_error 2 'base\.tum: covers 0 to' identify "$work/damaged"
cmp -s "$work/run_one/twin.json" "$work/damaged/twin.json" || fail 'a damaged run: twin.json changed'
for text in '[1]' '{"recognized": 3}' '{"recognized": {"mean": 4}}' '{"recognized": {"mean": {"psnr": "x"}}}' '{"rollout": {}}'; do
  damaged; echo "$text" >"$work/damaged/metrics.json"
  expect_error 2 'metrics\.json: ' diff "$work/run_one" "$work/damaged"
done

# a twin whose mass is none
for mass in none nan -1 '' 1e999 '0.06 kg'; do
  rm -rf "$work/heavy" && cp -r "$work/run_one" "$work/heavy"
  sed -i "s/\"mass\": \"[^\"]*\"/\"mass\": \"$mass\"/" "$work/heavy/twin.json"
  expect_error 2 "options.mass: '$mass' is not a positive number" identify "$work/heavy"
done

# covariances of the angles that are none
cp "$work/kept/covariance.csv" "$work/run_one/covariance.csv"
cp "$work/run_one/covariance.csv" "$work/good.csv"
bad_covariance() {  # awk's program for the third line
  awk -F, -v OFS=, "NR == 3 { $1 } 1" "$work/good.csv" >"$work/run_one/covariance.csv"
  expect_error 2 "covariance.csv:3: $2" identify "$work/run_one"
}
bad_covariance '$3 = 10' 'its numbers are no covariance'
bad_covariance '$2 = -$2' 'its numbers are no covariance'
bad_covariance '$2 = "nan"' 'column 2 is not a finite number'
awk -F, -v OFS=, 'NR == 3 { for (i = 2; i <= NF; ++i) $i = 0 } 1' "$work/good.csv" >"$work/run_one/covariance.csv"
run --json identify "$work/run_one"
expect_code 0 'identify, a frame that is known exactly'
python3 -m json.tool "$work/stdout" >"$work/null" || fail 'identify --json: is not JSON'

# file names that are not UTF-8 do not break what is JSON
odd=$work/odd$(printf '\377')
run --json new -o "$odd" --length 0.3 --joints 4 --bending planar --mass 0.06
expect_code 0 'new --json, a name that is not UTF-8'
python3 -m json.tool "$work/stdout" >"$work/null" || fail 'new --json, a name that is not UTF-8: is not JSON'
cp "$work/one.csv" "$odd.csv"
run --json identify "$odd" --markers "$odd.csv" --shape-only
expect_code 0 'identify --json, names that are not UTF-8'
python3 -m json.tool "$work/stdout" >"$work/null" || fail 'identify --json, names that are not UTF-8: is not JSON'
"$source_dir/tests/check_twin.py" "$work"/{rod,twin,run_one,run_two}/twin.json >"$work/stderr" || fail 'twin.json is not as docs/twin.schema.json says'
finish
