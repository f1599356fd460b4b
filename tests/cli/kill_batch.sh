#!/bin/bash
# kill_batch.sh PROGRAM [KILLS]: a batch killed (SIGKILL) at random instants and run again ends with the same bytes as an
# uninterrupted one, even where its trainings are still ending when the second begins. The instants are seeded and spread
# over the whole duration.
kills=${2:-1}
. "$(dirname "$0")/lib.sh"
mkdir "$work/captures"
ln -s "$source_dir/assets/demo_free_30" "$work/captures/demo"
cat >"$work/jobs.toml" <<'E1'
captures = ["captures/demo"]
seeds = [0, 1]
[settings]
joints = 3
bending = "planar"
frames = "0:6"
E1

same() {  # folder name: all but what tells of time
  local run file
  for run in "$work"/whole/*/twin.json; do
    run=$(basename "$(dirname "$run")")
    for file in gaussians.ply states.csv rollout.csv covariance.csv base.tum metrics.json; do
      cmp -s "$work/whole/$run/$file" "$1/$run/$file" || fail "$2: $run/$file is not that of an uninterrupted batch"
    done
    diff <(sed '/"durations"/,$d' "$work/whole/$run/twin.json") <(sed '/"durations"/,$d' "$1/$run/twin.json") >/dev/null ||
      fail "$2: $run/twin.json is not that of an uninterrupted batch"
    [ -e "$1/$run/checkpoint" ] && fail "$2: $run/checkpoint/ is left"
  done
  find "$1" -name '*.tmp*' | grep -q . && fail "$2: a half-written file is left"
}

start=$(date +%s%N)
run batch "$work/jobs.toml" -o "$work/whole"
expect_code 0 'the uninterrupted batch'
milliseconds=$((($(date +%s%N) - start) / 1000000))
[ "$(find "$work/whole" -name twin.json | wc -l)" -eq 2 ] || fail 'the uninterrupted batch: not two twins'

RANDOM=22
for ((i = 1; i <= kills; ++i)); do
  at=$((milliseconds * ((i - 1) * 1000 + RANDOM % 1000) / (kills * 1000)))
  rm -rf "$work/killed"
  "$program" batch "$work/jobs.toml" -o "$work/killed" >/dev/null 2>&1 </dev/null &
  pid=$!
  sleep "$(printf '%d.%03d' $((at / 1000)) $((at % 1000)))"
  kill -KILL $pid 2>/dev/null
  { wait $pid; } 2>/dev/null
  run batch "$work/jobs.toml" -o "$work/killed"  # at once
  expect_code 0 "a batch killed at $at ms and run again"
  before=$failures
  same "$work/killed" "killed at $at ms"
  [ $failures -eq "$before" ] && echo "kill $i of $kills at $at ms of $milliseconds: the same bytes"
done

# a training that has not ended yet when the batch is run again, as after a kill: its job waits for it
busy=$(dirname "$(ls "$work"/killed/*/twin.json | head -1)")
rm -rf "$busy" && mkdir -p "$busy/checkpoint"
flock "$busy/checkpoint/lock" sleep 2 &
sleep 0.2
run batch "$work/jobs.toml" -o "$work/killed"
expect_code 0 'a batch of which a training has not ended yet'
same "$work/killed" 'a batch of which a training has not ended yet'
finish
