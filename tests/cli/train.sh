#!/bin/bash
# A small training from end to end on whatever Vulkan device there is: results, interruption, resumption, a full disk.
. "$(dirname "$0")/lib.sh"
demo=$source_dir/assets/demo_free_30
small=(--joints 3 --bending planar --frames 0:12)

train() {  # folder, further options
  local folder=$1
  shift
  run train "$demo" -o "$folder" "${small[@]}" "$@"
}

train "$work/whole" --picture "$work/picture.png" --log "$work/log.jsonl"
expect_code 0 train
expect_output '^recognized +[0-9]' train
expect_output '^rollout +[0-9]' train
for file in twin.json gaussians.ply states.csv rollout.csv metrics.json log.jsonl; do
  [ -s "$work/whole/$file" ] || fail "train: no $file"
done
[ -e "$work/whole/checkpoint" ] && fail 'train: checkpoint/ is left'
grep -q 'given: only ratios' "$work/whole/twin.json" || fail "train: the capture's mass is not the twin's"
[ "$(wc -l <"$work/whole/states.csv")" -eq 13 ] || fail 'train: states.csv has not a row for every frame'
grep -q '"stage":"recognize"' "$work/log.jsonl" || fail 'train: no record of recognize in --log'
[ "$(head -c 4 "$work/picture.png" | tail -c 3)" = PNG ] || fail 'train: no picture'

# stopped as soon as it is at work, by SIGUSR1 and by Ctrl-C, then continued to the end: the same result
stop() {  # signal, exit code, further options
  local signal=$1 wanted=$2 before
  shift 2
  before=$(cat "$work/stopped/log.jsonl" 2>/dev/null | wc -l)
  "$program" train "$demo" -o "$work/stopped" "${small[@]}" "$@" >"$work/stdout" 2>"$work/stderr" </dev/null &
  local pid=$!
  for _ in $(seq 6000); do
    [ "$(cat "$work/stopped/log.jsonl" 2>/dev/null | wc -l)" -gt $((before + 1)) ] && break
    kill -0 $pid 2>/dev/null || break
    sleep 0.01
  done
  kill -s "$signal" $pid
  wait $pid
  code=$?
  expect_code "$wanted" "train, stopped by $signal"
  [ -d "$work/stopped/checkpoint" ] || fail "train, stopped by $signal: no checkpoint"
}
stop USR1 0
stop INT 130 --resume
expect_error 2 'not empty' train "$demo" -o "$work/stopped" "${small[@]}"
# a checkpoint of other frames or options is refused, and so is a finished recognition; nothing is touched
files() { (cd "$1" && find . -type f -exec sha256sum {} + | sort); }
other() {  # pattern for the checkpoint, pattern for the twin, further options
  # a fast device may be done with recognition before it is stopped: what is left is then the twin's
  expect_error 2 "$1|$2" train "$demo" -o "$work/stopped" "${small[@]}" "${@:3}" --resume
  expect_error 2 "$2" train "$demo" -o "$work/whole" "${small[@]}" "${@:3}" --resume
}
small_before=("${small[@]}") stopped_before=$(files "$work/stopped") whole_before=$(files "$work/whole")
small=(--joints 3 --bending planar)
other 'frames 0:12, not 2:14' "--frames '0:12', not '2:14'" --frames 2:14
small=(--bending planar --frames 0:12)
other '--joints 3, not auto' "--joints '3', not 'auto'"
small=("${small_before[@]}")
other '--seed 0, not 7' "--seed '0', not '7'" --seed 7
[ "$stopped_before" = "$(files "$work/stopped")" ] || fail 'train --resume of another job: the checkpoint changed'
[ "$whole_before" = "$(files "$work/whole")" ] || fail 'train --resume of another job: the twin changed'
# what somebody else put into the folders stays there
touch "$work/stopped/notes.tmp1" "$work/stopped/checkpoint/notes"
train "$work/stopped" --resume
expect_code 0 'train --resume'
[ -e "$work/stopped/notes.tmp1" ] && [ "$(ls "$work/stopped/checkpoint")" = notes ] ||
  fail "train --resume: somebody else's files are gone, or ours are left"
rm -r "$work/stopped/notes.tmp1" "$work/stopped/checkpoint"
for file in gaussians.ply states.csv rollout.csv; do
  cmp -s "$work/whole/$file" "$work/stopped/$file" || fail "train --resume: $file is not that of an uninterrupted run"
done

# followed by Adam, which knows no deviations, in the live window, which asks for the force on the rope
run estimate "$work/whole" --camera "$demo:cam0" --frames 0:6 --solver adam --covariance --serve $((20000 + $$ % 20000))
expect_code 0 'estimate --solver adam --serve'
[ "$(grep -c '"sigma":\[\],.*"covariance":\[\],' "$work/stdout")" -eq 6 ] || fail 'estimate --solver adam --serve: not six lines'

# what was made can be used
run rollout "$work/whole" -o - --rate 60
expect_code 0 rollout
[ "$(wc -l <"$work/stdout")" -eq 122 ] || fail "rollout: $(wc -l <"$work/stdout") lines instead of 122 (2 s at 60 Hz)"
run rollout "$work/whole" --base "$demo/base.tum" -o "$work/states.csv" --centerline "$work/centerline.csv" --json
expect_code 0 'rollout --base'
expect_output '"rows": 61' 'rollout --base'
expect_error 1 '/dev/full' rollout "$work/whole" -o /dev/full
expect_error 2 'would be overwritten' rollout "$work/whole" -o "$work/whole/states.csv"
# a motion that is longer than the recording, and elsewhere, is drawn to its end under its own base
{ awk '!/^#/ { $2 += 0.05; print }' "$demo/base.tum"
  seq 1 60 | awk -v last="$(tail -1 "$demo/base.tum")" '{ $0 = $1 " " last; t = 2 + $1 / 60; n = split(last, p, " "); printf "%.6f %.7f", t, p[2] + 0.05; for (i = 3; i <= n; ++i) printf " %s", p[i]; print "" }'
} >"$work/longer.tum"
run rollout "$work/whole" --base "$work/longer.tum" -o "$work/longer.csv"
expect_code 0 'rollout --base, longer'
[ -s "$work/longer.base.tum" ] || fail 'rollout: its base is not beside it'
run render "$work/whole" --states "$work/longer.csv" --camera "$demo:cam1" -o "$work/longer"
expect_code 0 'render of a longer motion'
[ "$(ls "$work/longer/cam1" | wc -l)" -eq 91 ] || fail "render of a longer motion: $(ls "$work/longer/cam1" | wc -l) frames instead of 91"
run render "$work/whole" --states "$work/longer.csv" --base "$work/longer.tum" --camera "$demo:cam1" -o "$work/same"
cmp -s "$work/longer/cam1/000080.png" "$work/same/cam1/000080.png" || fail 'render: another base than the one beside the states'
cp "$work/longer.csv" "$work/alone.csv"
run render "$work/whole" --states "$work/alone.csv" --camera "$demo:cam1" -o "$work/alone"
grep -q 'no base motion lies beside it' "$work/stderr" || fail 'render of states without a base: does not say so'
cmp -s "$work/longer/cam1/000030.png" "$work/alone/cam1/000030.png" && fail 'render: the base does not matter'
run render "$work/whole" --states "$work/whole/rollout.csv" --camera "$demo:cam1" -o "$work/frames" --mask --depth
expect_code 0 render
for ending in png mask.png depth.exr; do
  [ "$(ls "$work/frames/cam1" | grep -c "^[0-9]*\.$ending\$")" -eq 12 ] || fail "render: not 12 files *.$ending"
done
# on what the camera recorded: outside of the rope the outline's picture is the recorded one, whose first pixel is not black
run render "$work/whole" --camera "$demo:cam1" --layout outline -o "$work/outline"
expect_code 0 'render --layout outline'
[ "$(ls "$work/outline/cam1" | wc -l)" -eq 12 ] || fail 'render --layout: not 12 frames'
cmp -s "$work/outline/cam1/000000.png" "$work/frames/cam1/000000.png" && fail 'render --layout outline: draws the twin alone'
run render "$work/whole" --camera "$demo:cam1" --layout side-by-side -o "$work/beside.mp4"
expect_code 0 'render --layout side-by-side, a video'
expect_error 2 'side-by-side, overlay' render "$work/whole" --camera "$demo:cam1" --layout beside -o "$work/none"
expect_error 2 'undistorted' render "$work/whole" --camera "$demo:cam1" --layout wipe --undistorted -o "$work/none"
expect_error 2 'frames: is there already and not empty' render "$work/whole" --camera "$demo:cam0" -o "$work/frames"
[ -e "$work/frames/cam0" ] && fail 'render: writes into a folder that is not empty'
run render "$work/whole" --camera "$demo:cam0" -o "$work/frames" --force
expect_code 0 'render --force'
run render "$work/whole" --camera "$demo:cam0" -o "$work/video.mp4"
expect_code 0 'render video'
[ -s "$work/video.mp4" ] || fail 'render: no video'
run eval "$work/whole" "$demo" --frames 0:12 --json
expect_code 0 eval
[ "$(head -c 1 "$work/stdout")" = '{' ] || fail 'eval --json: does not begin with {'
run eval "$work/whole" "$demo" --frames 0:4 --lpips "$source_dir/tests/data/lpips/trunk.onnx"
expect_code 0 'eval --lpips'
expect_output 'SSIM +LPIPS +IoU' 'eval --lpips'
expect_output '^rollout mean +[0-9.]+ +[0-9.]+ +0\.[0-9]+ +0\.[0-9]{5} +0\.' 'eval --lpips'
run export "$work/whole" -o "$work/twin.glb"
expect_code 0 export
[ "$(head -c 4 "$work/twin.glb")" = glTF ] || fail 'export: no glTF'
run export "$work/whole" -o "$work/rope.urdf"
expect_code 0 'export .urdf'
python3 -c 'import sys, xml.dom.minidom as dom; dom.parse(sys.argv[1])' "$work/rope.urdf" || fail 'export: the URDF is no XML'
cp "$work/rope.urdf" "$work/kept.urdf"
expect_error 2 'is there already; name another file, or give --force' export "$work/whole" -o "$work/rope.urdf"
run export "$work/whole" -o "$work/rope.urdf" --force
cmp -s "$work/rope.urdf" "$work/kept.urdf" || fail 'export: the same URDF twice has other bytes'
gaussians=$(cksum <"$work/whole/gaussians.ply")
expect_error 2 'would be overwritten' export "$work/whole" -o "$work/whole/gaussians.ply"
[ "$gaussians" = "$(cksum <"$work/whole/gaussians.ply")" ] || fail 'export: its input is gone'
run synth "$work/whole" -o "$work/drawn"
expect_code 0 synth
run check "$work/drawn"
expect_code 0 'check of what synth made'
expect_error 2 "is the capture's own folder" synth "$work/whole" --camera "$work/drawn" -o "$work/drawn" --force
expect_error 2 "is the capture's own folder" render "$work/whole" --camera "$work/drawn" -o "$work/drawn" --force
run eval "$work/whole" "$work/drawn"
expect_code 0 'eval on another capture'
grep -q 'only the rollout' "$work/stderr" || fail 'eval on another capture: does not say so'
grep -q '^recognized' "$work/stdout" && fail 'eval on another capture: recognized states of the wrong capture'
run train "$demo" -o "$work/stopped" "${small[@]}" --resume --stages identify,rollout
expect_code 0 'train --resume --stages'
run identify "$work/whole"
expect_code 0 identify
cmp -s "$work/whole/rollout.csv" "$work/stopped/rollout.csv" || fail 'identify alone: not the rollout of train'

# a still or two: a twin that looks like the rope, and it is said that its dynamics are not known
for frames in 0:1 0:2; do
  run train "$demo" -o "$work/still" --frames $frames --joints 4 --force
  expect_code 0 "train --frames $frames"
  grep -q 'dynamics are not identified' "$work/stderr" || fail "train --frames $frames: does not say what is missing"
  grep -q '"recognized"' "$work/still/metrics.json" || fail "train --frames $frames: not evaluated"
  expect_error 2 'not identified' rollout "$work/still" -o "$work/states.csv"
  run render "$work/still" --camera "$demo:cam0" -o "$work/still.mp4"
  expect_code 0 "render of train --frames $frames"
done

# images and dynamics together, once; the capture's place is kept relative to the run folder
cp -r "$work/whole" "$work/joint"
run identify "$work/joint" --joint
expect_code 0 'identify --joint'
grep -q 'joint: images' "$work/stderr" || fail 'identify --joint: does not say what it found'
grep -q '"joint": "yes"' "$work/joint/twin.json" || fail 'identify --joint: twin.json does not say so'
cmp -s "$work/joint/rollout.csv" "$work/whole/rollout.csv" && fail 'identify --joint: the rollout of identify alone'
expect_error 2 'refined already' identify "$work/joint" --joint
rm "$work/whole/covariance.csv"
expect_error 2 'covariance.csv' identify "$work/whole" --joint

# an evaluation that fails all the same: the twin stays, and --resume goes on from it
cp -r "$demo" "$work/capture"
"$program" --no-progress train "$work/capture" -o "$work/late" "${small[@]}" >"$work/stdout" 2>"$work/stderr" </dev/null &
pid=$!
wait_for_file "$work/late/log.jsonl" $pid
sed -i '1s/.*/t,x,y,z/' "$work/capture/truth/centreline.csv"
wait $pid
code=$?
expect_code 1 'an evaluation that fails'
[ "$(grep -c '^chainsplat: error: .*centreline\.csv:1: .*; what exists so far is kept in .*--resume' "$work/stderr")" -eq 1 ] ||
  fail 'an evaluation that fails: no error line that says what is kept'
for file in twin.json gaussians.ply states.csv rollout.csv covariance.csv; do
  [ -s "$work/late/$file" ] || fail "an evaluation that fails: no $file"
done
cp "$demo/truth/centreline.csv" "$work/capture/truth/"
run train "$work/capture" -o "$work/late" "${small[@]}" --resume
expect_code 0 'train --resume after an evaluation that failed'
cmp -s "$work/late/metrics.json" "$work/stopped/metrics.json" || fail 'train --resume: other metrics'

# what was written is as the schema says
"$source_dir/tests/check_twin.py" "$work"/{whole,stopped,joint,late}/twin.json >"$work/stderr" || fail 'twin.json is not as docs/twin.schema.json says'

# something else where a file should go: refused before anything is removed
for name in log.jsonl base.tum metrics.json; do
  rm -rf "$work/blocked"
  cp -r "$work/stopped" "$work/blocked"
  rm "$work/blocked/$name" && mkdir "$work/blocked/$name" && touch "$work/blocked/$name/x"
  expect_error 2 "$name: is a folder" train "$demo" -o "$work/blocked" "${small[@]}" --force
  expect_error 2 "$name: is a folder" train "$demo" -o "$work/blocked" "${small[@]}" --resume
  [ -s "$work/blocked/twin.json" ] || fail "$name is a folder: the twin was removed"
done
ln -s nowhere "$work/link"
expect_error 2 'is a link to nothing' train "$demo" -o "$work/link" "${small[@]}"

# a twin without pictures
cp -r "$work/stopped" "$work/bare"
sed -i '/^ "gaussians"/d' "$work/bare/twin.json"
expect_error 2 'has no Gaussians to draw' eval "$work/bare" "$demo" --frames 0:12
expect_error 2 'has no Gaussians to draw' render "$work/bare" --camera "$demo" -o "$work/bare_frames"
expect_error 2 'has no Gaussians to draw' synth "$work/bare" -o "$work/bare_frames"
expect_error 2 'has no Gaussians to draw' train "$demo" -o "$work/bare" "${small[@]}" --resume

# no room on the disk: a file size limit stands for it
( ulimit -f 8; exec "$program" train "$demo" -o "$work/full" "${small[@]}" ) >"$work/stdout" 2>"$work/stderr" </dev/null
code=$?
expect_code 1 'full disk'
[ "$(grep -c '^chainsplat: error: ' "$work/stderr")" -eq 1 ] || fail 'full disk: not exactly one error line'
find "$work/full" -name '*.tmp*' | grep -q . && fail 'full disk: a half-written file is left'
finish
