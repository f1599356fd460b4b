#!/bin/bash
# Masks of stills in front of clutter, drawn by tools/make_clutter: their scores and warnings, help by the user, the
# contact sheet, the recipe of a color threshold. Skipped (77) without Debian's python3-numpy and ffmpeg.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
if ! /usr/bin/python3 -c 'import numpy' 2>/dev/null || ! command -v ffmpeg >/dev/null; then
  echo 'skipped: no python3-numpy or no ffmpeg'
  exit 77
fi

expect_iou() {  # least camera name; of the document on standard output
  local value
  value=$(sed -n "s/^ *\"$2\": \([0-9.]*\),\{0,1\}$/\1/p" "$work/stdout" | tail -1)
  awk -v value="${value:-0}" -v least="$1" 'BEGIN { exit !(value >= least) }' || fail "$3: IoU of $2 is ${value:-missing}, below $1"
}
warned() { grep -q 'probably wrong\|seems to begin' "$work/stderr"; }

# a still of a thin dark cable, the grasp 8 mm off
still=$work/still
"$source_dir/tools/make_clutter" "$still" --seed 4 --frames 1 --scale 0.5 --grasp-error 8 || fail 'make_clutter'
run mask "$still" -o "$work/masks" --preview "$work/sheet.png" --json
expect_code 0 'a still'
expect_iou 0.85 cam0 'a still'
warned && fail 'a still: a good mask is warned of'
[ "$(head -1 "$work/masks/scores.csv")" = camera,frame,score ] || fail 'a still: scores.csv has another header'
grep -Eq '^cam0,0,(0\.[89]|1\.)' "$work/masks/scores.csv" || fail 'a still: a good mask has a low score'
[ "$(head -c 4 "$work/sheet.png" | tail -c 3)" = PNG ] || fail 'a still: no contact sheet'

# the same with the base 20 cm beside: what is found there is warned of, or nothing is
cp -r "$still" "$work/beside"
awk '/^#/ { print; next } { $2 += 0.2; print }' "$still/base.tum" >"$work/beside/base.tum"
run mask "$work/beside" -o "$work/wrong" --json
if [ "$code" -eq 0 ]; then warned || fail 'a base 20 cm beside: no warning'; else expect_code 2 'a base 20 cm beside'; fi

# help by the user is read, and refused where it makes no sense
run mask "$still" -o "$work/box" --box cam0:0,0,640,480 --json
expect_code 0 'a box'
expect_iou 0.85 cam0 'a box'
# a dark cable before a dark window, whose edge is followed without help (IoU 0.10): one point on the cable or a picture of
# the scene, of another exposure, finds it
window=$work/window
"$source_dir/tools/make_clutter" "$window" --seed 43 --frames 1 --scale 0.5 --grasp-error 14 || fail 'make_clutter'
run mask "$window" -o "$work/pointed" --point cam0:282.5,146.7 --json
expect_code 0 'a point'
expect_iou 0.8 cam0 'a point'
run mask "$window" -o "$work/without" --empty "cam0=$window/truth/empty/cam0.png" --json
expect_code 0 'an empty scene'
expect_iou 0.75 cam0 'an empty scene'
# a black cable before a black window, whose frame is followed without help, and beyond one point: it is warned of. Three
# points leave it no way along the frame (IoU 0.005, 0.3 and 0.6)
frame=$work/frame
"$source_dir/tools/make_clutter" "$frame" --seed 1202 --frames 1 --scale 0.5 || fail 'make_clutter'
run mask "$frame" -o "$work/missed" --point cam0:339.7,177.9 --json
expect_code 0 'one point on a hardly seen cable'
warned || fail 'one point on a hardly seen cable: no warning'
grep -q 'does not run through' "$work/stderr" && fail 'one point on a hardly seen cable: it is missed'
run mask "$frame" -o "$work/three_points" --point cam0:336.9,104.0 --point cam0:339.7,177.9 --point cam0:341.0,247.6 --json
expect_code 0 'three points'
expect_iou 0.5 cam0 'three points'
# what no rope runs through is said, and so is what none can reach
run mask "$still" -o "$work/off" --point cam0:20,20 --json
expect_code 0 'a point beside the cable'
warned || fail 'a point beside the cable: no warning'
grep -q -e '--point cam0:20,20: the mask does not run through it' "$work/stderr" ||
  fail 'a point beside the cable: no word about the point'
cp -r "$still" "$work/short"
sed 's/"length": [0-9.]*/"length": 0.05/' "$still/capture.json" >"$work/short/capture.json"
expect_error 2 'from the grasp, and the rope reaches' mask "$work/short" -o "$work/none" --point cam0:20,20
# and so is a mask of a white cable's lit middle alone
middle=$work/middle
"$source_dir/tools/make_clutter" "$middle" --seed 615 --frames 1 --scale 0.5 || fail 'make_clutter'
run mask "$middle" -o "$work/lit" --empty "cam0=$middle/truth/empty/cam0.png" --json
expect_code 0 'the lit middle of a cable'
warned || fail 'the lit middle of a cable: no warning'
# and one that goes over from a black cable to a green one
other=$work/other
"$source_dir/tools/make_clutter" "$other" --seed 4009 --frames 1 --scale 0.5 || fail 'make_clutter'
run mask "$other" -o "$work/goes_over" --json
expect_code 0 'a mask that goes over to another cable'
warned || fail 'a mask that goes over to another cable: no warning'
# a box is of its frame, also where the scene is known: around all of them this one changes frame 1
three=$work/three
"$source_dir/tools/make_clutter" "$three" --seed 43 --frames 3 --scale 0.5 --grasp-error 14 || fail 'make_clutter'
run mask "$three" -o "$work/no_box" --empty "cam0=$three/truth/empty/cam0.png"
run mask "$three" -o "$work/box_0" --empty "cam0=$three/truth/empty/cam0.png" --box cam0:0:0,0,250,480
cmp "$work/no_box/cam0/000001.png" "$work/box_0/cam0/000001.png" || fail "frame 0's box is frame 1's, too"
expect_error 2 'no camera cam7; it has cam0' mask "$still" -o "$work/none" --point cam7:10,10
expect_error 2 'outside of the picture' mask "$still" -o "$work/none" --point cam0:9999,10
expect_error 2 'no such frame' mask "$still" -o "$work/none" --point cam0:3:10,10
expect_error 2 'is not CAMERA:X,Y' mask "$still" -o "$work/none" --point cam0:10
expect_error 2 'is not CAMERA=FILE' mask "$still" -o "$work/none" --empty cam0
expect_error 2 'does not go with' mask "$still" -o "$work/none" --point cam0:10,10 --command 'x {image} {mask}'
[ -e "$work/none" ] && fail 'refused help: something was written'

# four views of a rope on a table, the grasp 1 cm and the diameter 2 mm off
table=$work/table
"$source_dir/tools/make_clutter" "$table" --family table --seed 0 --scale 0.5 --grasp-error 10 --diameter-error -2 ||
  fail 'make_clutter --family table'
run mask "$table" -o "$work/views" --json
expect_code 0 'a table'
for camera in cam0 cam1 cam2 cam3; do expect_iou 0.85 $camera 'a table'; done
warned && fail 'a table: a good mask is warned of'

# a rope on a table that is darker in its shadow, all along one side of it in all views
shadow=$work/shadow
"$source_dir/tools/make_clutter" "$shadow" --family table --seed 504 --scale 0.5 || fail 'make_clutter --family table'
run mask "$shadow" -o "$work/in_shadow" --json
expect_code 0 'a shadow'
for camera in cam0 cam1 cam2 cam3; do expect_iou 0.91 $camera 'a shadow'; done

# the recipe of docs/guide.md, 3: a color threshold
run mask "$table" -o "$work/threshold" --json --command "ffmpeg -v error -y -i {image} -vf \"format=gbrp,geq=r='255*gt(g(X,Y)-b(X,Y),60)*gt(g(X,Y)-r(X,Y),10)':g=0:b=0,extractplanes=r\" {mask}"
expect_code 0 'a color threshold'
expect_iou 0.6 cam0 'a color threshold'
finish
