#!/bin/bash
# import: what it says, what it writes, and one line for everything that cannot be.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
demo=$source_dir/assets/demo_free_30 raw=$source_dir/assets/raw_opencv_csv kalibr=$source_dir/assets/raw_kalibr_tum
out=$work/capture
rope=(--length 0.3 --diameter 0.02 --scenario free)
opencv=(--camera cam0="$demo/cam0.mp4" --calibration cam0="$raw/cam0.yaml" --base-world x,-z,y --tool 0,0,0.12,0,0,0,1
  --direction z "${rope[@]}")
stamps=(--timestamps "$raw/frames.csv#stamp_ms")

refused() {  # pattern options...
  local pattern=$1
  shift
  expect_error 2 "$pattern" import "$out" "$@"
  [ -e "$out" ] && fail "$pattern: something was written" && rm -rf "$out"
}

# what was decided is said; without masks the way to them is named
run import "$out" "${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv"
expect_code 0 'import'
expect_output 'cam0: intrinsics from OpenCV, half a pixel added' 'import'
expect_output 'cam0: pose .*rvec, tvec takes the world to the camera' 'import'
expect_output 'base: positions in mm, by their names' 'import'
expect_output 'grasp: bending axis 0.000, 1.000, 0.000' 'import'
expect_output "chainsplat mask $out" 'import'
expect_error 2 'not empty.*--force' import "$out" "${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv"
# again, with masks, as one document
run import "$out" "${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv" --masks cam0="$demo/masks/cam0" --force --json
expect_code 0 'import --force --json'
python3 -c 'import json, sys; d = json.load(sys.stdin); assert d["check"]["usable"] and d["notes"] and d["pictures"], d' \
  <"$work/stdout" || fail 'import --json: another document'
rm -r "$out"
mkdir "$out" && touch "$out/mine"
expect_error 2 'not made by import' import "$out" "${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv" --force
rm -r "$out"

# a base that begins later and ends earlier than the frames: these frames are left out, and their masks
awk -F, 'NR == 1 || (NR > 41 && NR < 201)' "$raw/robot.csv" >"$work/short.csv"
run import "$out" "${opencv[@]}" "${stamps[@]}" --base "$work/short.csv" --masks cam0="$demo/masks/cam0"
expect_code 0 'a short base'
expect_output 'cam0: 20 of 60 frames are outside of the base' 'a short base'
[ -s "$out/cam0/000039.png" ] && [ -s "$out/masks/cam0/000039.png" ] && [ ! -e "$out/cam0/000040.png" ] ||
  fail 'a short base: not 40 frames'
cmp -s "$out/masks/cam0/000000.png" "$demo/masks/cam0/000000.png" && fail 'a short base: its masks begin with frame 0'
rm -r "$out"

# a log that goes on for minutes: only its part about the frames is kept
{ cat "$raw/robot.csv"
  tail -1 "$raw/robot.csv" | awk -F, -v OFS=, -v CONVFMT=%.3f '{ for (i = 1; i <= 60; ++i) { $1 += 5000; print } }'; } >"$work/long.csv"
run import "$out" "${opencv[@]}" "${stamps[@]}" --base "$work/long.csv"
expect_code 0 'a long log'
expect_output 'base: 59 of 301 poses are more than 1 s from all frames' 'a long log'
rm -r "$out"

# without any clock: found from the masks, to about the frame's interval that rope and gripper leave open
run import "$out" "${opencv[@]}" --start auto --masks "$demo/masks/cam0" --base "$raw/robot.csv"
expect_code 0 'import --start auto'
start=$(python3 -c 'import json, sys; print(json.load(open(sys.argv[1]))["cameras"][0]["start"])' "$out/capture.json")
awk -v start="$start" 'BEGIN { exit !(start > 0.22 && start < 0.28) }' || fail "import --start auto: $start instead of 0.25"
rm -r "$out"
refused 'has none.*--masks' "${opencv[@]}" --start auto --base "$raw/robot.csv"

# rows that are read one after the other: given, said and written; masks tell when the middle one is read
run import "$out" "${opencv[@]}" --start auto --masks "$demo/masks/cam0" --base "$raw/robot.csv" --readout 20ms
expect_code 0 'import --readout'
expect_output 'cam0: its rows are read in 20 ms' 'import --readout'
python3 -c 'import json, sys
camera = json.load(open(sys.argv[1]))["cameras"][0]
assert camera["readout"] == 0.02 and abs(camera["start"] - (float(sys.argv[2]) - 0.01)) < 1e-6, camera' \
  "$out/capture.json" "$start" || fail 'import --readout: not what was given'
rm -r "$out"
readout=("${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv" --readout)
refused 'readout: 0.5 s is more than any camera' "${readout[@]}" 0.5
refused 'readout: cam0: 0.05 s are more than the 0.0333.* from frame to frame' "${readout[@]}" 50ms
refused "readout: '20 px' has no unit" "${readout[@]}" '20 px'

# what cannot be
sed 's/image_width: 320/image_width: 640/' "$raw/cam0.yaml" >"$work/large.yaml"
refused '640x240.*320x240' "${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv" --calibration cam0="$work/large.yaml"
echo 'nothing: here' >"$work/nothing.yaml"
refused 'no known format.*OpenCV.*Kalibr.*COLMAP.*nerfstudio' "${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv" \
  --calibration cam0="$work/nothing.yaml"
awk -F, -v OFS=, -v CONVFMT=%.3f 'NR > 1 { $1 += 7200000 } { print }' "$raw/robot.csv" >"$work/later.csv"
refused 'never overlap.*differ by -2 h.*--start cam0=7200' "${opencv[@]}" "${stamps[@]}" --base "$work/later.csv"
refused 'no clock' "${opencv[@]}" --base "$raw/robot.csv"
refused "no column is called like a time.*it has a, b" "${opencv[@]}" "${stamps[@]}" --base <(printf 'a,b\n1,2\n')
refused 'no column .nothing.*it has frame, stamp_ms' "${opencv[@]}" --base "$raw/robot.csv" --timestamps "$raw/frames.csv#nothing"
refused 'bag_to_files' "${opencv[@]}" "${stamps[@]}" --base "$work/log.mcap"
refused 'cam9.*no camera' "${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv" --rate cam9=30
refused '60 frames' "${opencv[@]}" --base "$raw/robot.csv" --timestamps <(head -30 "$raw/frames.csv")
mkdir "$work/few" && cp "$demo/masks/cam0/"00000[0-4].png "$work/few"
refused '5 masks for 60 frames' "${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv" --masks cam0="$work/few"
refused 'not perpendicular' "${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv" --bending-axis z
refused 'length' "${opencv[@]/#0.3/0}" "${stamps[@]}" --base "$raw/robot.csv"
refused 'table' "${opencv[@]/#free/tabletop}" "${stamps[@]}" --base "$raw/robot.csv"
# Kalibr alone does not know the robot
refused 'to each other.*--pose cam0=' --camera cam0="$demo/cam0.mp4" --camera cam1="$demo/cam1.mp4" --calibration "$kalibr/camchain.yaml" \
  --timestamps "$kalibr/frames_ns.txt" --base "$kalibr/gripper.tum" --direction=-z "${rope[@]}"
# a video is read more than once
mkfifo "$work/pipe"
refused 'pipe.*can be read once.*into a file' "${opencv[@]/#cam0=*.mp4/cam0=$work/pipe}" "${stamps[@]}" --base "$raw/robot.csv"
# a pose of which the file does not say which way it maps: the view tells, where it can
python3 - "$demo/capture.json" "$work" <<'END'
import json, sys
m = json.load(open(sys.argv[1]))["cameras"][0]["world_from_camera"]
r = [m[0:3], m[4:7], m[8:11]]; t = [m[3], m[7], m[11]]
back = [[r[k][i] for k in range(3)] + [-sum(r[k][i] * t[k] for k in range(3))] for i in range(3)] + [[0, 0, 0, 1]]
json.dump({"H": [m[0:4], m[4:8], m[8:12], m[12:16]]}, open(sys.argv[2] + "/there.json", "w"))
json.dump({"H": back}, open(sys.argv[2] + "/back.json", "w"))
END
for way in there back; do
  sed '/rvec/,$d' "$raw/cam0.yaml" >"$work/optics.yaml"
  run import "$out" "${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv" --calibration cam0="$work/optics.yaml" \
    --pose cam0="$work/$way.json"
  expect_code 0 "pose $way"
  expect_output 'since only so the camera sees the grasp' "pose $way"
  python3 - "$out/capture.json" "$demo/capture.json" <<'END' || fail "pose $way: another pose"
import json, sys
a, b = (json.load(open(p))["cameras"][0]["world_from_camera"] for p in sys.argv[1:])
assert max(abs(x - y) for x, y in zip(a, b)) < 1e-6
END
  rm -r "$out"
done
# without a pose
refused 'no pose of cam0.*--pose cam0=' "${opencv[@]}" "${stamps[@]}" --base "$raw/robot.csv" --calibration cam0="$work/optics.yaml"
finish
