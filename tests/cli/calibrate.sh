#!/bin/bash
# calibrate: the board to print, a calibration that import reads, and one line for everything that cannot be.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
board_frames=$2 board=$work/board.json out=$work/out

# the board
run calibrate --board-svg "$work/board.svg" --tags 3x2 --tag-size 60mm --spacing 2cm --first-id 5
expect_code 0 'a board'
expect_output 'Print .*board.svg at 100 %.*' 'a board'
grep -q '^<svg .*width="260.000mm" height="196.000mm"' "$work/board.svg" || fail 'a board: another size'
python3 -c 'import json, sys; d = json.load(open(sys.argv[1])); assert d["tag_size"] == 0.06 and d["first_id"] == 5, d' "$board" ||
  fail 'a board: another description'
run calibrate --board-svg "$work/"$'b\xff.svg' --json
expect_code 0 'calibrate --board-svg, a name that is no UTF-8'
expect_error 2 'exists already' calibrate --board-svg "$work/board.svg"
expect_error 2 '--tags: .5by7. is no grid' calibrate --board-svg "$work/other.svg" --tags 5by7
expect_error 2 '--spacing: .*too little white' calibrate --board-svg "$work/other.svg" --spacing 1mm
expect_error 2 'has no unit' calibrate --board-svg "$work/other.svg" --tag-size 3in
expect_error 2 '--first-id: .*more than there are' calibrate --board-svg "$work/other.svg" --first-id 580
[ -e "$work/other.svg" ] && fail 'a board that is refused was written'

# a robot moves it
"$board_frames" "$board" "$work/raw" || fail 'board_frames'
raw=$work/raw
run calibrate "$out" --camera cam0="$raw/cam0.mp4" --start 1 --board "$board" --base "$raw/robot.tum"
expect_code 0 'calibrate'
expect_output 'cam0: 24 frames of 400x300, 10 frames per second by the video.s header, frame 0 at 1 s' 'calibrate'
expect_output "poses are in the world of the robot's log" 'calibrate'
expect_output 'fx 3(79|80).* fy 38[01]' 'calibrate'
expect_output 'clock: frames are taken -?0\.[0-9]+ \+- .* ms later than given; --start cam0=(1.00|0.99)' 'calibrate'
expect_output 'board on the flange: 0.0(09|10)' 'calibrate'
expect_output '^This calibration ' 'calibrate'
[ -s "$out/pictures/cam0.png" ] || fail 'calibrate: no picture'
run calibrate "$work/again" --camera cam0="$raw/cam0.mp4" --start 1 --board "$board" --base "$raw/robot.tum" --json --threads 1
expect_code 0 'calibrate --json'
python3 -c 'import json, sys; d = json.load(sys.stdin); assert d["trusted"] and len(d["cameras"]) == 1 and d["robot"], d' \
  <"$work/stdout" || fail 'calibrate --json: another document'
cmp -s "$out/calibration.json" "$work/again/calibration.json" || fail 'calibrate: another result with one thread'
# import takes it as it is
run import "$work/capture" --camera cam0="$raw/cam0" --rate 10 --start 1 --calibration cam0="$out/cam0.json" \
  --base "$raw/robot.tum" --length 0.3 --diameter 0.02 --scenario free --direction z
python3 - "$out/cam0.json" "$work/capture/capture.json" <<'P' || fail 'import: another camera than calibrate found'
import json, sys
a, b = json.load(open(sys.argv[1])), json.load(open(sys.argv[2]))["cameras"][0]
for key in ("fx", "fy", "cx", "cy"):
    assert abs(a[key] - b[key]) < 1e-9, key
assert max(abs(x - y) for x, y in zip(a["world_from_camera"], b["world_from_camera"])) < 1e-9
P
# a hand moves it
run calibrate "$work/hand" --camera cam0="$raw/cam0" --rate 10 --board "$board" --world board
expect_code 0 'calibrate by hand'
expect_output "poses are in the board's frame where cam0 sees it first" 'calibrate by hand'

# what is not good enough is kept, said, and exit code 1
run calibrate "$work/still" --camera cam0="$raw/cam0" --rate 10 --start 1 --board "$board" --base "$raw/still.tum"
expect_code 1 'a robot at rest'
expect_output '^bad: the flange turned about one axis only' 'a robot at rest'
expect_output '^Do not use this calibration' 'a robot at rest'
grep -q '^chainsplat: error: .*not good enough; record again' "$work/stderr" || fail 'a robot at rest: no error line'
[ -s "$work/still/calibration.json" ] || fail 'a robot at rest: nothing was kept'

refused() {  # pattern options...
  local pattern=$1
  shift
  expect_error 2 "$pattern" calibrate "$work/none" "$@"
  [ -e "$work/none" ] && fail "$pattern: something was written" && rm -rf "$work/none"
}
cam=(--camera cam0="$raw/cam0.mp4")
refused '--board: is missing' "${cam[@]}"
refused '--camera: there is none' --board "$board"
refused "has no name; write NAME=VIDEO" --camera "$raw/cam0.mp4" --board "$board"
refused 'gone.mp4: does not exist' --camera cam0="$work/gone.mp4" --board "$board"
refused 'gone.json' "${cam[@]}" --board "$work/gone.json"
refused "'cam7' is no camera; there are cam0" "${cam[@]}" --board "$board" --rate cam7=10
refused "'auto' needs the robot's motion" "${cam[@]}" --board "$board" --start auto
refused "the world is the robot's" "${cam[@]}" --board "$board" --base "$raw/robot.tum" --world board
refused 'robot.tum: covers 0 to 4.5 s, and cam0 is recorded from 70 to 72.3 s' "${cam[@]}" --board "$board" --base "$raw/robot.tum" --start 70
sed 's/"first_id": 5/"first_id": 300/' "$board" >"$work/other.json"
refused 'cam0.mp4: cam0 never sees the board in 24 frames, but the tags 5, 6, .*and the board has 300 to 305' "${cam[@]}" --board "$work/other.json"
sed 's/"first_id"/"first"/' "$board" >"$work/other.json"
refused "other.json: has the unknown key 'first'" "${cam[@]}" --board "$work/other.json"
printf '1 2 3\n' >"$work/few.tum"
refused 'few.tum' "${cam[@]}" --board "$board" --base "$work/few.tum"
expect_error 2 'exists already' calibrate "$out" "${cam[@]}" --board "$board"
expect_error 2 'is no calibration' calibrate "$raw" "${cam[@]}" --board "$board" --force
expect_error 2 'OUT: is missing' calibrate "${cam[@]}" --board "$board"

finish
