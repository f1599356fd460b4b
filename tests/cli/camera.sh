#!/bin/bash
# camera.sh PROGRAM FAKE_CAMERA CAMERA_FRAMES: estimate from a V4L2 device that fake_camera.cpp plays: the same states as
# from standard input, always of the newest frame, and what is left when the device changes its mind; from streams of
# Y4M; and both by a program without the readers of videos and images. Needs no Vulkan.
. "$(dirname "$0")/lib.sh"
fake=$2
demo=$source_dir/assets/demo_free_30
twin=$work/twin
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
export ASAN_OPTIONS="$ASAN_OPTIONS:verify_asan_link_order=0"

make_straight_twin "$twin" "$demo"
"$3" "$demo" cam0 "$work" || { echo 'FAILED: no frames'; exit 1; }
python3 - "$demo/capture.json" "$work" <<'END'
import json, sys
camera = json.load(open(sys.argv[1]))["cameras"][0]
camera = {key: camera[key] for key in ("name", "width", "height", "fx", "fy", "cx", "cy", "world_from_camera", "rate")}
json.dump(camera, open(sys.argv[2] + "/camera.json", "w"))
camera["width"] += 2
json.dump(camera, open(sys.argv[2] + "/other.json", "w"))
del camera["rate"]
camera["width"] -= 2
json.dump(camera, open(sys.argv[2] + "/unpaced.json", "w"))
END

export FAKE_CAMERA=/dev/video97 FAKE_CAMERA_SIZE=320x240
live() {  # settings of the camera, then arguments; the lines go to $work/stdout
  local settings=()
  while [[ $1 == *=* ]]; do settings+=("FAKE_CAMERA_$1"); shift; done
  env "${settings[@]}" LD_PRELOAD="$fake" "$program" estimate "$twin" --camera "$FAKE_CAMERA" "$@" \
    >"$work/stdout" 2>"$work/stderr" </dev/null
  code=$?
}
said() {  # code pattern name
  expect_code "$1" "$3"
  [ "$(grep -c '^chainsplat: error: ' "$work/stderr")" -eq 1 ] || fail "$3: not exactly one error line"
  grep -Eq "^chainsplat: error: $2" "$work/stderr" || fail "$3: no line like '$2'"
}
from_stdin() {  # file for the lines, arguments
  local lines=$1
  shift
  "$program" estimate "$twin" --camera - --base "$demo/base.tum" --calibration "$work/camera.json" "$@" \
    <"$work/rgb" >"$lines" 2>"$work/stderr" || fail "frames from standard input: exit code $?"
}
# $work/stdout has the frames of `lines`, all but `missing`, at their times, and angles that differ by `rms` as the colors do
same() {  # lines rms(rad) missing name
  python3 - "$1" "$work/stdout" "$2" "$3" <<'END' || fail "$4: not the states of standard input"
import json, sys
wanted, got = ({line["frame"]: line for line in map(json.loads, open(name))} for name in sys.argv[1:3])
if sys.argv[4]:
    del wanted[int(sys.argv[4])]
if sorted(wanted) != sorted(got):
    sys.exit(f"frames {sorted(got)} instead of {sorted(wanted)}")
late = max(abs(line["time"] - got[frame]["time"]) for frame, line in wanted.items())
away = [a - b for frame, line in wanted.items() for a, b in zip(line["theta"], got[frame]["theta"])]
rms = (sum(x * x for x in away) / len(away)) ** 0.5
if late > 2e-6 or rms > float(sys.argv[3]) or any(line["lost"] for line in got.values()):
    sys.exit(f"angles differ by {rms} rad, times by {late} s")
END
}
yuyv=(YUYV="$work/yuyv") mjpg=(MJPG="$work/mjpg") step=(STRIDE=1)
calibration=(--calibration "$work/camera.json")
moving=("${calibration[@]}" --base "$demo/base.tum")

# silent after five frames: that takes its time, and goes on beside the rest
env FAKE_CAMERA_YUYV="$work/yuyv" FAKE_CAMERA_STRIDE=1 FAKE_CAMERA_SILENT=5 LD_PRELOAD="$fake" \
  "$program" estimate "$twin" --camera "$FAKE_CAMERA" "${calibration[@]}" >"$work/silent" 2>"$work/silence" </dev/null &
silent=$!

# every frame, until it disappears
from_stdin "$work/all"
mkdir "$work/alone"
cp "$program" "$work/alone/chainsplat"
whole=$program
live "${yuyv[@]}" "${step[@]}" GONE=60 "${moving[@]}" --centerline "$work/line.csv"
said 1 '/dev/video97: gives no more frames after 60 \(No such device\); ' 'a device that disappears'
same "$work/all" 0.02 '' 'YUYV'
[ "$(wc -l <"$work/line.csv")" -eq 61 ] || fail 'a device that disappears: the centerline was not kept'
live "${mjpg[@]}" "${step[@]}" GONE=60 "${moving[@]}"
same "$work/all" 0.05 '' 'MJPEG'
# raw frames come too slowly, compressed ones do not
live "${yuyv[@]}" "${mjpg[@]}" YUYV_RATE=10 "${step[@]}" GONE=60 "${moving[@]}"
same "$work/all" 0.05 '' 'MJPEG where YUYV is slow'
grep -q 'frames a second' "$work/stderr" && fail 'MJPEG where YUYV is slow: a warning about the rate'
live "${yuyv[@]}" YUYV_RATE=10 "${step[@]}" GONE=2 "${moving[@]}"
grep -q '^chainsplat: warning: /dev/video97: gives 10 frames a second in this size instead of 30' "$work/stderr" ||
  fail 'a slow camera: no warning'
# a damaged frame is passed over
live "${yuyv[@]}" "${step[@]}" DAMAGED=7 GONE=60 "${moving[@]}"
same "$work/all" 0.02 7 'a damaged frame'

# a frame whose time stamp is not after the one before's is passed over, a camera without time stamps given up
live "${yuyv[@]}" "${step[@]}" BACK=7 GONE=60 "${moving[@]}"
same "$work/all" 0.02 7 'a time stamp that goes back'
live "${yuyv[@]}" STOPPED=7 "${moving[@]}" --centerline "$work/line.csv"  # in real time, so some of the seven may be missed
said 1 '/dev/video97: its time stamps do not increase, from frame ([7-9]|10); ' 'time stamps that stand still'
[ "$(wc -l <"$work/line.csv")" -ge 2 ] || fail 'time stamps that stand still: the centerline was not kept'

# frames of Y4M: from standard input, a pipe, a file, at the stream's own rate
stream() {  # file for standard input, SOURCE, arguments
  local input=$1 source=$2
  shift 2
  "$program" estimate "$twin" --camera "$source" --base "$demo/base.tum" "$@" >"$work/stdout" 2>"$work/stderr" <"$input"
  code=$?
}
stream "$work/y4m" - "${calibration[@]}"
expect_code 0 'Y4M from standard input'
same "$work/all" 0.02 '' 'Y4M from standard input'
cp "$work/stdout" "$work/streamed"
mkfifo "$work/frames"
cat "$work/y4m" >"$work/frames" &
stream /dev/null "$work/frames" --calibration "$work/unpaced.json"
expect_code 0 'Y4M from a pipe'
same "$work/streamed" 0 '' 'Y4M from a pipe'
cp "$work/y4m" "$work/frames.y4m"
stream /dev/null "$work/frames.y4m" --calibration "$work/unpaced.json"
same "$work/streamed" 0 '' 'Y4M from a file'
head -c 500000 "$work/y4m" >"$work/cut"
stream "$work/cut" - "${calibration[@]}"
said 1 'standard input: ends within a frame; write the stream again; the states so far are kept' 'Y4M that is cut off'
[ "$(wc -l <"$work/stdout")" -eq 3 ] || fail 'Y4M that is cut off: not the states of three frames'
stream "$work/y4m" - --calibration "$work/other.json"
said 1 'standard input: frame 0 has 320x240 pixels, the calibration says 322x240; ' 'Y4M of another size'
echo 'YUV4MPEG2 W320 H240 F30:1 C420p10' >"$work/deep"
stream "$work/deep" - "${calibration[@]}"
said 2 "standard input: has Y4M samples of the kind '420p10'; send 8 bits" 'Y4M of 10 bits'
expect_error 2 '--rate: is needed' estimate "$twin" --camera - --calibration "$work/unpaced.json"

# the camera takes three frames while the program works on one: always the newest, at its own time
stream "$work/y4m" - "${calibration[@]}" --drop 3
cp "$work/stdout" "$work/third"
live "${yuyv[@]}" STRIDE=3 GONE=60 "${moving[@]}"
sed -i '$d' "$work/stdout"  # what was newest at the end
same "$work/third" 1e-6 '' 'a program that is slower than the camera'

# a program that has neither FFmpeg nor OpenImageIO
program=$work/alone/chainsplat
run estimate "$twin" --camera "$demo/cam0.mp4" "${calibration[@]}"
grep -q 'chainsplat_videos.so: cannot be loaded' "$work/stderr" || fail 'alone: it is not'
stream "$work/y4m" - "${calibration[@]}" --mcap "$work/alone.mcap" --centerline "$work/line.csv"
expect_code 0 'alone, from Y4M'
same "$work/streamed" 0 '' 'alone, from Y4M'
python3 "$source_dir/tests/read_mcap.py" "$work/alone.mcap" >"$work/mcap" || fail 'alone, from Y4M: the recording'
live "${mjpg[@]}" "${step[@]}" GONE=60 "${moving[@]}"
same "$work/all" 0.05 '' 'alone, MJPEG'
program=$whole

# another size than the calibration's
live "${yuyv[@]}" "${step[@]}" --calibration "$work/other.json"
said 1 '/dev/video97: frame 0 has 320x240 pixels, the calibration says 322x240; ' 'another size'
[ -s "$work/stdout" ] && fail 'another size: states'

# times: from the first frame on, or by a clock that the robot has too
live "${yuyv[@]}" "${step[@]}" GONE=3 "${moving[@]}" --start 0.5
expect_output '"frame":0,"time":0\.5,' '--start 0.5'
live "${yuyv[@]}" "${step[@]}" EARLY=2 GONE=4 "${moving[@]}"
expect_output '"frame":2,"time":0\.0666' 'a camera that was there before the program was ready'
before=$(date +%s)
live "${yuyv[@]}" "${step[@]}" GONE=3 "${calibration[@]}" --start unix
time=$(sed -n '1s/.*"time":\([0-9]*\).*/\1/p' "$work/stdout")
[ "${time:-0}" -ge "$before" ] && [ "$time" -le "$(date +%s)" ] || fail "--start unix: the first frame is at '$time'"
grep -q '"lost":true' "$work/stdout" && fail '--start unix: lost'
live "${yuyv[@]}" "${step[@]}" GONE=3 "${moving[@]}" --start -3
grep -q '^chainsplat: warning: .*base.tum: the base motion begins 3 s after the first frame' "$work/stderr" ||
  fail 'a base motion that begins later: no warning'
live "${yuyv[@]}" "${step[@]}" "${moving[@]}" --start soon
said 2 "--start: 'soon' is no time; " '--start soon'
expect_error 2 '--start: only a device' estimate "$twin" --camera - "${calibration[@]}" --start unix
expect_error 2 '--start: a capture' estimate "$twin" --camera "$demo:cam0" --start 1

# asked to stop while it waits: for the camera, for standard input
stopped() {  # signal code pid lines name
  wait_for_file "$4" "$3"
  kill "-$1" "$3"
  wait "$3"
  code=$?
  expect_code "$2" "$5"
  [ -s "$work/stopped.csv" ] || fail "$5: the centerline was not kept"
  rm -f "$work/stopped.csv" "$4"
}
: >"$work/stderr"
env FAKE_CAMERA_YUYV="$work/yuyv" FAKE_CAMERA_STRIDE=1 FAKE_CAMERA_SILENT=2 LD_PRELOAD="$fake" "$program" estimate \
  "$twin" --camera "$FAKE_CAMERA" "${calibration[@]}" --centerline "$work/stopped.csv" >"$work/lines" 2>/dev/null </dev/null &
stopped TERM 143 $! "$work/lines" 'SIGTERM while the camera is silent'
mkfifo "$work/pipe"
for signal in INT:130 TERM:143 USR1:0; do
  # bash lets what it starts in the background ignore SIGINT
  env --default-signal=INT "$program" estimate "$twin" --camera - "${calibration[@]}" --centerline "$work/stopped.csv" \
    <"$work/pipe" >"$work/lines" 2>/dev/null &
  pid=$!
  exec 3>"$work/pipe"
  head -c $((5 * 3 * 320 * 240 + 1000)) "$work/rgb" >&3
  stopped "${signal%:*}" "${signal#*:}" $pid "$work/lines" "SIG${signal%:*} while standard input is silent"
  exec 3>&-
done

wait $silent
code=$?
cp "$work/silence" "$work/stderr"
said 1 '/dev/video97: gives no more frames after 5 \(silent\); ' 'a camera that falls silent'
[ "$(wc -l <"$work/silent")" -eq 5 ] || fail 'a camera that falls silent: not the states of five frames'
finish
