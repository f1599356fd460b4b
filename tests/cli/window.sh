#!/bin/bash
# The live window in a real browser: chromium without a screen opens the page, and what it drew is read back.
# Skipped (77) where there is no chromium.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
demo=$source_dir/assets/demo_free_30
browser=$(command -v chromium || command -v chromium-browser || command -v google-chrome) || browser=
port=$((20000 + $$ % 20000))
# a twin without dynamics that has been recognized once, hanging straight
run new --length 0.3 --joints 4 --bending planar -o "$work/twin"
expect_code 0 new
sed -i '$d' "$work/twin/twin.json"
echo ', "states": "states.csv"}' >>"$work/twin/twin.json"
printf 'time,theta_1,theta_2,theta_3,theta_4\n0,0,0,0,0\n' >"$work/twin/states.csv"
cp "$demo/base.tum" "$work/twin/"

# a port that is taken, and one that is none
python3 -c "
import socket, sys, time
s = socket.socket(); s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
s.bind(('127.0.0.1', $port)); s.listen(); print('taken', flush=True); time.sleep(60)" >"$work/taken" 2>/dev/null &
holder=$!
for _ in $(seq 50); do [ -s "$work/taken" ] && break; sleep 0.1; done
if [ -s "$work/taken" ]; then
  expect_error 2 "--serve $port.*cannot be had" estimate "$work/twin" --camera "$demo:cam0" --serve "$port"
fi
kill "$holder" 2>/dev/null
expect_error 2 'serve' estimate "$work/twin" --camera "$demo:cam0" --serve 0

if [ -z "$browser" ]; then
  echo 'skipped: there is no chromium'
  [ "$failures" -eq 0 ] && exit 77
  finish
fi

# Two seconds of capture may be over before the browser is there: estimate runs again and again while it looks.
port=$((port + 1))
(while [ ! -e "$work/enough" ]; do
  "$program" estimate "$work/twin" --camera "$demo:cam0" --serve "$port" >"$work/lines" 2>"$work/stderr" </dev/null
  echo "$? $(grep -c '"frame":' "$work/lines")" >>"$work/runs"
done) &
estimator=$!
browse "$port" 'data-frames="[0-9]'
touch "$work/enough"
wait "$estimator"
# the estimator comes to its end whether or not somebody looks
grep -qv '^0 60$' "$work/runs" && fail "estimate --serve: exit code and lines are $(tr '\n' ';' <"$work/runs")"
grep -q 'data-frames="[0-9]' "$work/dom" || fail 'the page shows no frame'
grep -q 'data-line="[1-9]' "$work/dom" || fail 'the page drew no chain'
grep -q 'data-bars="[1-9]' "$work/dom" || fail 'the latency plot is empty'
grep -Eq 'id="trust" class="(good|doubt|bad)"' "$work/dom" || fail 'the page says nothing about trust'
finish
