#!/bin/bash
# kill.sh PROGRAM [KILLS] [OPTIONS OF TRAIN...]: a training killed (SIGKILL) at random instants and resumed ends with the
# same bytes as an uninterrupted one. The instants are seeded and spread over the whole duration. Also: two processes on
# one folder, and a checkpoint that was damaged.
kills=${2:-1}
options=("${@:3}")
[ ${#options[@]} -gt 0 ] || options=(--joints 3 --bending planar --frames 0:12)
. "$(dirname "$0")/lib.sh"
demo=$source_dir/assets/demo_free_30

train() {  # folder, further options
  run train "$demo" -o "$1" "${options[@]}" "${@:2}"
}

same() {  # folder name: all but what tells of time
  local file
  for file in gaussians.ply states.csv rollout.csv covariance.csv base.tum metrics.json; do
    cmp -s "$work/whole/$file" "$1/$file" || fail "$2: $file is not that of an uninterrupted run"
  done
  diff <(sed '/"durations"/,$d' "$work/whole/twin.json") <(sed '/"durations"/,$d' "$1/twin.json") >/dev/null ||
    fail "$2: twin.json is not that of an uninterrupted run"
  [ -e "$1/checkpoint" ] && fail "$2: checkpoint/ is left"
  find "$1" -name '*.tmp*' | grep -q . && fail "$2: a half-written file is left"
}

start=$(date +%s%N)
train "$work/whole"
expect_code 0 'the uninterrupted run'
milliseconds=$((($(date +%s%N) - start) / 1000000))

RANDOM=16
for ((i = 1; i <= kills; ++i)); do
  # one instant a slice of the duration, so that few kills still meet every stage
  at=$((milliseconds * ((i - 1) * 1000 + RANDOM % 1000) / (kills * 1000)))
  rm -rf "$work/killed"
  "$program" train "$demo" -o "$work/killed" "${options[@]}" >"$work/stdout" 2>"$work/stderr" </dev/null &
  pid=$!
  sleep "$(printf '%d.%03d' $((at / 1000)) $((at % 1000)))"
  kill -KILL $pid 2>/dev/null
  { wait $pid; } 2>/dev/null
  left=$(cd "$work/killed" 2>/dev/null && ls -d checkpoint/*.bin twin.json metrics.json 2>/dev/null | tr '\n' ' ')
  train "$work/killed" --resume
  expect_code 0 "resumed after a kill at $at ms"
  before=$failures
  same "$work/killed" "killed at $at ms"
  [ $failures -eq "$before" ] && echo "kill $i of $kills at $at ms of $milliseconds (${left:-nothing yet}): the same bytes"
done

# the second process on one folder refuses, and leaves the first alone
rm -rf "$work/killed"
"$program" train "$demo" -o "$work/killed" "${options[@]}" >/dev/null 2>&1 </dev/null &
pid=$!
wait_for_file "$work/killed/checkpoint/recognize.before.bin" $pid
kill -STOP $pid  # on a fast device it would else be done before the others have begun
expect_error 2 'another process works in this folder' train "$demo" -o "$work/killed" "${options[@]}" --resume
expect_error 2 'another process works in this folder' train "$demo" -o "$work/killed" "${options[@]}" --force

# killed, and the last checkpoint damaged: the one before serves
kill -KILL $pid
{ wait $pid; } 2>/dev/null
printf 'damage' | dd of="$work/killed/checkpoint/recognize.bin" bs=1 seek=200 conv=notrunc 2>/dev/null
train "$work/killed" --resume
expect_code 0 'resumed with a damaged checkpoint'
grep -q '^chainsplat: warning: .*recognize\.bin: the checkpoint is damaged' "$work/stderr" ||
  fail 'a damaged checkpoint: no warning that names it'
same "$work/killed" 'a damaged checkpoint'
finish
