#!/bin/bash
# kill_estimate.sh PROGRAM [KILLS]: what follows a rope, killed (SIGKILL) at random instants, has written whole lines, those
# of an uninterrupted run, and leaves the twin and an older centerline as they were. The instants are seeded.
kills=${2:-1}
. "$(dirname "$0")/lib.sh"
demo=$source_dir/assets/demo_free_30
make_straight_twin "$work/twin" "$demo"
following=(estimate "$work/twin" --camera "$demo:cam0")
slowly=(--serve $((20000 + $$ % 20000)))  # the window shows recorded frames at their own pace: time to be killed in
run "${following[@]}" --centerline "$work/whole.csv"
expect_code 0 'the uninterrupted run'
without_latency() { sed 's/,"latency_ms":[^,}]*//'; }
without_latency <"$work/stdout" >"$work/whole"
start=$(date +%s%N)
run "${following[@]}" "${slowly[@]}"
expect_code 0 'the uninterrupted run at the pace of the recording'
milliseconds=$((($(date +%s%N) - start) / 1000000))
twin_before=$(cd "$work/twin" && sha256sum * | sha256sum)
echo 'an older file' >"$work/line.csv"

RANDOM=23
for ((i = 1; i <= kills; ++i)); do
  at=$((milliseconds * ((i - 1) * 1000 + RANDOM % 1000) / (kills * 1000)))
  "$program" "${following[@]}" "${slowly[@]}" --centerline "$work/line.csv" >"$work/lines" 2>/dev/null </dev/null &
  pid=$!
  sleep "$(printf '%d.%03d' $((at / 1000)) $((at % 1000)))"
  kill -KILL $pid 2>/dev/null
  { wait $pid; } 2>/dev/null
  before=$failures
  lines=$(wc -l <"$work/lines")
  [ -s "$work/lines" ] && [ "$(tail -c 1 "$work/lines" | od -An -c | tr -d ' ')" != '\n' ] &&
    fail "killed at $at ms: the last line is cut"
  cmp -s <(without_latency <"$work/lines") <(head -n "$lines" "$work/whole") ||
    fail "killed at $at ms: the lines are not those of an uninterrupted run"
  if [ "$lines" -lt "$(wc -l <"$work/whole")" ]; then
    [ "$(cat "$work/line.csv")" = 'an older file' ] || fail "killed at $at ms: the older centerline was touched"
  else
    cmp -s "$work/line.csv" "$work/whole.csv" || [ "$(cat "$work/line.csv")" = 'an older file' ] ||
      fail "killed at $at ms: the centerline is neither old nor new"
    echo 'an older file' >"$work/line.csv"
  fi
  [ "$(cd "$work/twin" && sha256sum * | sha256sum)" = "$twin_before" ] || fail "killed at $at ms: the twin has changed"
  rm -f "$work"/line.csv.tmp*  # what was being written; the next run names its own file
  [ $failures -eq "$before" ] && echo "kill $i of $kills at $at ms of $milliseconds: $lines whole lines"
done
finish
