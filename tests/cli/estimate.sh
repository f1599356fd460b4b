#!/bin/bash
# estimate: its inputs, its lines, and what is left when the input ends in the wrong way. Needs no Vulkan device.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
demo=$source_dir/assets/demo_free_30
twin=$work/twin

make_straight_twin "$twin" "$demo"

lines() {  # count name
  [ "$(wc -l <"$work/stdout")" -eq "$1" ] || fail "$2: $(wc -l <"$work/stdout") lines instead of $1"
  [ "$(grep -c '^{"frame":.*,"time":.*,"theta":\[.*\],"thetadot":\[.*\],"sigma":\[.*,"latency_ms":[0-9.]*}$' \
    "$work/stdout")" -eq "$1" ] || fail "$2: lines that are no estimates"
}
# exit code 1, one error line that matches, `count` estimates
broken() {  # count pattern arguments...
  local count=$1 pattern=$2
  shift 2
  run estimate "$twin" "$@"
  expect_code 1 "estimate $*"
  [ "$(grep -c '^chainsplat: error: ' "$work/stderr")" -eq 1 ] || fail "estimate $*: not exactly one error line"
  grep -Eq -- "^chainsplat: error: $pattern" "$work/stderr" || fail "estimate $*: no line like '$pattern'"
  lines "$count" "estimate $*"
}

run estimate "$twin" --camera "$demo:cam0"
expect_code 0 'one camera'
lines 60 'one camera'
[ "$(grep -c '"lost":false' "$work/stdout")" -eq 60 ] || fail 'one camera: lost'
grep -Eq '^60 frames; p50 .* ms, p99 .* ms\.$' "$work/stderr" || fail 'one camera: no latency'
run estimate "$twin" --camera "$demo" --drop 2 --frames 10:30 --centerline "$work/line.csv" --covariance
expect_code 0 'all cameras'
lines 10 'all cameras'
[ "$(grep -c '"covariance":\[' "$work/stdout")" -eq 10 ] || fail 'all cameras: no covariance'
[ "$(wc -l <"$work/line.csv")" -eq 11 ] || fail 'all cameras: not a centerline for every frame'

# a calibration, and frames that have its size or not
{ echo '{"name": "cam0", "width": 320, "height": 240, "fx": 307.5, "fy": 307.5, "cx": 160, "cy": 120, "rate": 30,'
  echo ' "world_from_camera": [1,0,0,0, 0,0,1,-0.8, 0,-1,0,0.4, 0,0,0,1]}'; } >"$work/camera.json"
sed 's/"width": 320/"width": 322/' "$work/camera.json" >"$work/other.json"
frame_bytes=$((3 * 320 * 240))
head -c $((5 * frame_bytes)) /dev/zero >"$work/frames"
stream() {  # file for standard input, arguments...
  local file=$1
  shift
  "$program" estimate "$twin" "$@" <"$file" >"$work/stdout" 2>"$work/stderr"
  code=$?
}
stream "$work/frames" --camera - --calibration "$work/camera.json"
expect_code 0 'raw frames'
lines 5 'raw frames'
head -c $((3 * frame_bytes + 100)) "$work/frames" >"$work/cut"
stream "$work/cut" --camera - --calibration "$work/camera.json"
expect_code 1 'raw frames that end within one'
lines 3 'raw frames that end within one'
grep -q '^chainsplat: error: standard input: ends within a frame' "$work/stderr" || fail 'raw frames, cut: which line?'
broken 0 '.*cam0\.mp4: frame 0 has 320x240 pixels, the calibration says 322x240; ' \
  --camera "$demo/cam0.mp4" --calibration "$work/other.json"

# a video that ends early: its last part is missing
head -c $(($(stat -c %s "$demo/cam0.mp4") * 9 / 10)) "$demo/cam0.mp4" >"$work/cut.mp4"
run estimate "$twin" --camera "$work/cut.mp4" --calibration "$work/camera.json"
expect_code 1 'a video that ends early'
count=$(wc -l <"$work/stdout")
[ "$count" -gt 30 ] && [ "$count" -lt 60 ] || fail "a video that ends early: $count lines"
[ "$(grep -c '^chainsplat: error: .*cut\.mp4: frame' "$work/stderr")" -eq 1 ] || fail 'a video that ends early: which line?'

# a base motion that stops: the first second
awk '$1 <= 1.0 || /^#/' "$demo/base.tum" >"$work/base.tum"
broken 32 '.*base\.tum: the base motion ends at [0-9.]+ s, before frame 32; ' --camera "$demo:cam0" --base "$work/base.tum" \
  --centerline "$work/stopped.csv"
[ "$(wc -l <"$work/stopped.csv")" -eq 33 ] || fail 'a base motion that stops: the centerline was not kept'

# times that do not increase
broken 1 '.*cam0\.mp4: frame 1 is at 1e\+22 s, not after the one before; ' --camera "$demo/cam0.mp4" \
  --calibration "$work/camera.json" --start 1e22

# whoever reads the lines has seen enough: what is to be kept is kept
{ "$program" estimate "$twin" --camera "$demo:cam0" --centerline "$work/read.csv" --covariance 2>"$work/stderr"
  echo $? >"$work/code"; } | head -2 >"$work/stdout"
lines 2 'two lines read'
[ "$(cat "$work/code")" -eq 141 ] || fail "two lines read: exit code $(cat "$work/code")"
grep -Evq '^([0-9]+ frames; p50 .*|chainsplat: warning: .*)$' "$work/stderr" && fail 'two lines read: it complains'
[ "$(head -1 "$work/read.csv" 2>/dev/null | cut -c 1-4)" = time ] || fail 'two lines read: the centerline was not kept'
"$program" estimate "$twin" --camera "$demo:cam0" --centerline "$work/full.csv" >/dev/full 2>"$work/stderr"
code=$?
expect_code 1 'a full disk under the lines'
grep -q '^chainsplat: error: standard output: writing failed; ' "$work/stderr" || fail 'a full disk under the lines: which line?'
[ -s "$work/full.csv" ] || fail 'a full disk under the lines: the centerline was not kept'

# nobody reads and the pipe is full: the first SIGTERM has to wait, the second one does not
mkfifo "$work/lines" "$work/video"
"$program" estimate "$twin" --camera "$demo:cam0" --covariance >"$work/lines" 2>"$work/stderr" </dev/null &
pid=$!
exec 4<"$work/lines"
head -c 1 <&4 >/dev/null
sleep 1
kill -TERM $pid
sleep 0.3
kill -TERM $pid
for _ in $(seq 40); do kill -0 $pid 2>/dev/null || break; sleep 0.05; done
kill -KILL $pid 2>/dev/null
{ wait $pid; } 2>/dev/null
code=$?
exec 4<&-
expect_code 143 'a second SIGTERM'
# nothing to keep yet: the first signal ends it, whatever it waits for
"$program" estimate "$twin" --camera "$work/video" --calibration "$work/camera.json" >"$work/stdout" 2>"$work/stderr" </dev/null &
pid=$!
exec 4>"$work/video"  # waits until it is opened for reading
kill -TERM $pid
for _ in $(seq 40); do kill -0 $pid 2>/dev/null || break; sleep 0.05; done
kill -KILL $pid 2>/dev/null
{ wait $pid; } 2>/dev/null
code=$?
exec 4>&-
expect_code 143 'SIGTERM while a video is opened'

# devices: one that is none, one that is not there
expect_error 2 '/dev/null: is no camera that V4L2 can read' estimate "$twin" --camera /dev/null \
  --calibration "$work/camera.json"
expect_error 2 '/dev/video97: does not exist' estimate "$twin" --camera /dev/video97 --calibration "$work/camera.json"

expect_error 2 '--calibration: is needed with' estimate "$twin" --camera "$demo/cam0.mp4"
expect_error 2 '--calibration: is needed with' estimate "$twin" --camera -
expect_error 2 '--base: standard input is for the frames' estimate "$twin" --camera - --base - --calibration "$work/camera.json"
expect_error 2 '--calibration: is needed with' estimate "$twin" --camera /dev/null
expect_error 2 'adam draws the twin' estimate "$twin" --camera "$demo:cam0" --solver adam
expect_error 2 'does not exist' estimate "$twin" --camera "$work/none.mp4" --calibration "$work/camera.json"
expect_error 2 '--drop' estimate "$twin" --camera "$demo:cam0" --drop 0
finish
