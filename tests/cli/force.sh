#!/bin/bash
# 'chainsplat force': what each way to name a contact gives, and what is wrong with the others.
. "$(dirname "$0")/lib.sh"
demo=$source_dir/assets/demo_free_30

run train "$demo" -o "$work/twin" --joints 3 --bending planar --frames 0:12
expect_code 0 train
states=$work/twin/states.csv
force() { run force "$work/twin" --states "$states" --base "$demo/base.tum" "$@"; }

force
expect_code 0 'force'
[ "$(wc -l <"$work/stdout")" -eq 12 ] || fail 'force: not a line a state'
expect_output '^\{"time":.*"link":.*"arclength":.*"force":\[.*"sigma":\[.*"touching":.*"low":\[.*"unit":"N' force
force --live
expect_code 0 'force --live'
[ "$(wc -l <"$work/stdout")" -eq 12 ] || fail 'force --live: not a line a state'

# live, from a pipe: the first line comes when two more states are there, before the stream ends
estimates() {  # first and last of the 12 states, as 'estimate' prints them
  awk -F, -v first="$1" -v last="$2" 'NR > first && NR <= last + 1 {
    printf "{\"time\":%s,\"theta\":[%s,%s,%s],\"sigma\":[0.01,0.01,0.01],\"lost\":false}\n", $1, $2, $3, $4 }' "$states"
}
wait_for_line() {  # at most ten seconds
  for _ in $(seq 200); do [ -s "$work/live" ] && return; sleep 0.05; done
}
: >"$work/live"
{ estimates 1 4; wait_for_line; wc -l <"$work/live" >"$work/early"; estimates 5 12; } |
  "$program" -q force "$work/twin" --estimate - --base "$demo/base.tum" --live >"$work/live" || fail 'force --live, pipe'
[ "$(cat "$work/early")" -ge 1 ] || fail 'force --live: no line before the stream ended'
[ "$(wc -l <"$work/live")" -eq 12 ] || fail 'force --live, pipe: not a line a state'

# a twin that rests bent where the rope hangs straight feels a hand: the live window draws its force
browser=$(command -v chromium || command -v chromium-browser || command -v google-chrome) || browser=
if [ -n "$browser" ]; then
  cp -r "$work/twin" "$work/bent"
  python3 - "$work/bent/twin.json" <<'END'
import json, sys
twin = json.load(open(sys.argv[1]))
for joint in twin["chain"]["joints"][:2]:
    joint["rest_angle"] += 1.0
json.dump(twin, open(sys.argv[1], "w"))
END
  port=$((40000 + $$ % 20000))
  (while [ ! -e "$work/enough" ]; do
    "$program" -q estimate "$work/bent" --camera "$demo:cam0" --solver silhouette --serve "$port" >"$work/lines" 2>/dev/null </dev/null
  done) &
  estimator=$!
  browse "$port" 'data-arrows="[1-9]'
  touch "$work/enough"
  wait "$estimator"
  grep -q 'data-arrows="[1-9]' "$work/dom" || fail 'the live window drew no arrow of a force'
fi

# a contact at the free end, and none
point=$(sed -n '1s/.*"point":\[\([^]]*\)\].*/\1/p' "$work/stdout")
force --contact "$point"
expect_code 0 'force --contact X,Y,Z'
printf 'time,x,y,z\n0,%s\n0.1,,,\n' "$point" >"$work/contact.csv"
force --contact "$work/contact.csv"
expect_code 0 'force --contact FILE.csv'

# a hand as a depth camera's program writes it
{ printf 'ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\nend_header\n'
  echo 'nan nan nan'; echo "${point//,/ }"; } >"$work/hand.ply"
force --hand "$work/hand.ply"
expect_code 0 'force --hand'
[ "$(wc -l <"$work/stdout")" -eq 12 ] || fail 'force --hand: not a line a state'
expect_error 2 'excludes' force "$work/twin" --states "$states" --hand "$work/hand.ply" --contact "$point"

# live, and the input breaks off: what was written is kept
{ estimates 1 8; echo '{"time":'; } |
  "$program" force "$work/twin" --estimate - --base "$demo/base.tum" --live >"$work/stdout" 2>"$work/stderr"
code=${PIPESTATUS[1]}
expect_code 1 'force --live, a line that is cut off'
[ "$(wc -l <"$work/stdout")" -eq 6 ] || fail 'force --live, a line that is cut off: not the lines before'
grep -q '^chainsplat: error: -: line 9: .*; the lines so far are kept$' "$work/stderr" || fail 'force --live: which line?'
# nobody reads on
: >"$work/stdout"
{ estimates 1 8; wait_for_file "$work/stdout" $$; sleep 0.3; estimates 9 12; } |  # the reader has gone by then
  { "$program" force "$work/twin" --estimate - --base "$demo/base.tum" --live 2>"$work/stderr"; echo $? >"$work/code"; } | head -1 >"$work/stdout"
[ "$(cat "$work/code")" -eq 141 ] || fail "force --live, one line read: exit code $(cat "$work/code")"
grep -q error "$work/stderr" && fail 'force --live, one line read: it complains'

# lines that no estimate printed, whole or live
strange() {  # code pattern name; the lines are in $work/strange.jsonl
  local live
  for live in '' --live; do
    run force "$work/twin" --estimate "$work/strange.jsonl" --base "$demo/base.tum" $live
    expect_code "$1" "$3 $live"
    grep -Eq "^chainsplat: error: .*$2" "$work/stderr" || fail "$3 $live: no line like '$2'"
    grep -q nan "$work/stdout" && fail "$3 $live: nan"
  done
}
estimates 1 12 | sed '1s/"sigma":[^]]*]/"sigma":[]/' >"$work/strange.jsonl"
strange 2 'line 2: has deviations' 'deviations in some lines'
estimates 1 12 | sed '2s/"sigma":[^]]*]/"sigma":[]/' >"$work/strange.jsonl"
strange 2 'line 2: has no deviations' 'no deviations in some lines'
head -c 80000000 /dev/zero >"$work/strange.jsonl"
strange 2 'a line of more than 64 MiB' 'a line without end'
run force "$work/twin" --estimate "$work" --base "$demo/base.tum"
expect_code 2 'estimates from a folder'

# estimates without deviations
estimates 1 12 | sed 's/"sigma":[^]]*]/"sigma":[]/' >"$work/plain.jsonl"
run force "$work/twin" --estimate "$work/plain.jsonl" --base "$demo/base.tum"
expect_code 0 'force of estimates without deviations'

printf 'time,x,y,z\n0,,,\n' >"$work/none.csv"
expect_error 2 'no contact' force "$work/twin" --states "$states" --base "$demo/base.tum" --contact "$work/none.csv"
expect_error 2 'never comes nearer' force "$work/twin" --states "$states" --base "$demo/base.tum" --contact 100,0,0
expect_error 2 'names no contact' force "$work/twin" --states "$states" --base "$demo/base.tum" --contact 1e200,0,0
expect_error 2 'is no point' force "$work/twin" --states "$states" --base "$demo/base.tum" --contact 1,2
sed '1!s/^[^,]*/9&/' "$states" >"$work/late.csv"
expect_error 2 'base motion covers' force "$work/twin" --states "$work/late.csv" --base "$demo/base.tum"
printf 'time,theta_1\n0,0\n1,0\n2,0\n' >"$work/other.csv"
expect_error 2 'other.csv' force "$work/twin" --states "$work/other.csv" --base "$demo/base.tum"
expect_error 2 'one of the two' force "$work/twin"
# a device that is asked for and not there is no reason to go on without one
expect_error 2 "no device is 'none'" estimate "$work/twin" --camera "$demo:cam0" --device none

# what no rope's state can be is refused with its line and field; every line that is written is JSON
json_lines() { python3 -c 'import json, sys
def refuse(word): raise ValueError(word)
for line in sys.stdin: json.loads(line, parse_constant=refuse)' <"$work/stdout" || fail "$1: a line is not JSON"; }
changed() { estimates 1 12 | sed "5$1" >"$work/changed.jsonl"; }
bad_line() {  # sed's command for the fifth line, pattern
  changed "$1"
  expect_error 2 "changed.jsonl: line 5: $2" force "$work/twin" --estimate "$work/changed.jsonl" --base "$demo/base.tum"
}
good_line() {  # sed's command for the fifth line
  changed "$1"
  run force "$work/twin" --estimate "$work/changed.jsonl" --base "$demo/base.tum"
  expect_code 0 "force of estimates, $1"
  json_lines "force of estimates, $1"
}
covariance() { echo "s/\"lost\"/\"covariance\":[$1],\"lost\"/"; }
bad_line "$(covariance 1,5,1,0,0,1)" 'covariance: is not positive semidefinite'
bad_line "$(covariance 1,0,-1,0,0,1)" 'covariance: is not positive semidefinite'
bad_line "$(covariance null,0,1,0,0,1)" 'covariance: is no finite number'
bad_line "$(covariance 1e308,0,1,0,0,1)" 'covariance: 1e.308 is beyond'
bad_line "$(covariance 1,0,1)" 'covariance: is no lower triangle'
good_line "$(covariance 0,0,0,0,0,0)"
good_line "$(covariance 1e-4,1e-4,1e-4,1e-4,1e-4,1e-4)"
good_line 's/"sigma":[^]]*/"sigma":[0,0,0/'
bad_line 's/"sigma":\[0.01/"sigma":[-0.01/' 'sigma: is negative'
bad_line 's/"sigma":\[0.01/"sigma":[nan/' "is no line of 'chainsplat estimate'"
bad_line 's/"sigma":\[0.01/"sigma":[1e200/' 'sigma: 1e.200 is beyond'
bad_line 's/"theta":\[[^,]*/"theta":[1e308/' 'theta: 1e.308 is beyond'
bad_line 's/"theta":\[[^,]*/"theta":[null/' 'theta: is no finite number'
bad_line 's/"theta":\[[^,]*,/"theta":[/' 'theta: has 2 angles, the twin 3'
bad_line 's/"time":[^,]*/"time":0.01/' 'time: 0.01 s is not after'
bad_line 's/"time":[^,]*/"time":1e308/' 'time: 1e.308 is beyond'
# angles that no check can call wrong, and no force can be told from
sed '5s/,[^,]*,/,1e200,/' "$states" >"$work/huge.csv"
expect_error 2 '; .*check the states' force "$work/twin" --states "$work/huge.csv" --base "$demo/base.tum"

# what the twin does not know of its parameters' covariance is named, not dropped; what is no covariance is refused
edit_twin() {  # python
  rm -rf "$work/edited" && cp -r "$work/twin" "$work/edited"
  python3 - "$work/edited/twin.json" "$1" <<'END'
import json, sys
twin = json.load(open(sys.argv[1]))
names, covariance = twin["identification"]["names"], twin["identification"]["covariance"]
exec(sys.argv[2])
json.dump(twin, open(sys.argv[1], "w"))
END
}
mean_sigma() { python3 -c 'import json, sys
lines = [json.loads(line) for line in sys.stdin]
print(sum(line["sigma"][0] for line in lines))' <"$work/stdout"; }
# where it is touched is given: else the spread of where it may be counts, too
force --contact 0,0,0.3
all=$(mean_sigma)
edit_twin 'covariance[0][0] = None'
run force "$work/edited" --states "$states" --base "$demo/base.tum" --contact 0,0,0.3
expect_code 0 'force, a null in the covariance'
grep -q 'warning: twin.json: identification.covariance: has null for log_stiffness; .*leave out' "$work/stderr" ||
  fail 'force, a null in the covariance: no warning'
some=$(mean_sigma)
edit_twin 'covariance[:] = [[None] * len(names) for _ in names]'
run force "$work/edited" --states "$states" --base "$demo/base.tum" --contact 0,0,0.3
grep -q 'warning: twin.json: .*null for log_stiffness, .*assume' "$work/stderr" ||
  fail 'force, no covariance: no warning'
edit_twin 'covariance[:] = [[0.0] * len(names) for _ in names]'
run force "$work/edited" --states "$states" --base "$demo/base.tum" --contact 0,0,0.3
none=$(mean_sigma)
awk -v all="$all" -v some="$some" -v none="$none" 'BEGIN { exit !(all > none && some > none) }' ||
  fail "force, a null in the covariance: of the sigmas $all (all known), $some (one unknown), $none (all certain) the last is not the least"
edit_twin 'covariance[0][1] = covariance[1][0] = 1e3'
expect_error 2 'identification.covariance: is not symmetric and positive' force "$work/edited" --states "$states"
edit_twin 'covariance[0][0] = None'
expect_error 2 'knows no covariance' excite "$work/edited" -o "$work/motion"
estimates 1 12 >"$work/lines.jsonl"
expect_error 2 'knows no covariance' identify "$work/edited" --online "$work/lines.jsonl"

# the same lines teach a twin, which stays as it is where they are wrong
before=$(cat "$work/twin/twin.json")
changed 's/"sigma":\[0.01/"sigma":[-0.01/'
expect_error 2 'changed.jsonl:5: sigma: is negative' identify "$work/twin" --online "$work/changed.jsonl"
changed 's/"theta":\[[^,]*/"theta":[1e308/'
expect_error 2 'changed.jsonl:5: theta: 1e.308 is beyond' identify "$work/twin" --online "$work/changed.jsonl"
changed 's/"time":[^,]*/"time":0.01/'
expect_error 2 'changed.jsonl:5: time: 0.01 s is not after' identify "$work/twin" --online "$work/changed.jsonl"
[ "$before" = "$(cat "$work/twin/twin.json")" ] || fail 'identify --online: a refused file changed the twin'
estimates 1 12 | sed 's/"sigma":[^]]*/"sigma":[0,0,0/' >"$work/changed.jsonl"
run --json identify "$work/twin" --online "$work/changed.jsonl"
expect_code 0 'identify --online, standard deviations of zero'
python3 -m json.tool "$work/stdout" >"$work/null" || fail 'identify --online --json: is not JSON'
force
expect_code 0 'force of an adapted twin'
json_lines 'force of an adapted twin'
finish
