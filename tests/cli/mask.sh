#!/bin/bash
# Masks for a capture that has none: by our own means, by an outside program, and what can go wrong.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
demo=$source_dir/assets/demo_free_30
capture=$work/capture

bare() {  # the demo without masks
  rm -rf "$capture"
  cp -r "$demo" "$capture"
  rm -rf "$capture/depth" "$capture/truth" "$capture/masks"
  sed -i '/"depth/d; /"masks"/d' "$capture/capture.json"
}

# an image that is not masked leads to this command
bare
expect_error 2 "make them: chainsplat mask $capture" train "$capture" -o "$work/run" --frames 0:12
run check "$capture"
expect_code 2 'check, no masks'
expect_output '^problem: .*make them: chainsplat mask' 'check, no masks'

# some frames into a folder, compared with the capture's own
run mask "$demo" -o "$work/masks" --frames 0:16
expect_code 0 'mask -o'
expect_output '^cam1: IoU 0\.[789]' 'mask -o'
[ "$(find "$work/masks" -name '*.png' | wc -l)" -eq 48 ] || fail 'mask -o: not 48 masks'
expect_error 2 'not empty.*--force' mask "$demo" -o "$work/masks"
expect_error 2 'cam0 has masks already.*--force' mask "$demo"
expect_error 2 '--frames.*-o' mask "$capture" --frames 0:8
expect_error 2 'no frame' mask "$demo" -o "$work/none" --frames 400:410
[ -e "$work/none" ] && fail 'no frame: something was written'
# masks that lie there, though capture.json does not name them, are not written over
mkdir -p "$capture/masks/cam1"
echo drawn by hand >"$capture/masks/cam1/000031.png"
expect_error 2 'cam1 has masks already.*--force' mask "$capture"
rm -r "$capture/masks"

# an outside program, whose arguments may hold anything
segmenter="$work/it's a segmenter.sh"
cat >"$segmenter" <<'SCRIPT'
#!/bin/bash
# copies a mask that is there, by the frame's number
count=$(cat "$STATE/count"); echo $((count + 1)) >"$STATE/count"
[ -s "$1" ] || exit 9
echo 'chatter on standard output'
camera=$((count / FRAMES)) frame=$((count % FRAMES))
[ "$count" = "$FAIL_AT" ] && exit 3
cp "$MASKS/cam$camera/$(printf %06d $frame).png" "$2"
SCRIPT
chmod +x "$segmenter"
export STATE=$work MASKS=$demo/masks FRAMES=60 FAIL_AT=none TMPDIR="$work/a folder"
mkdir "$TMPDIR"
line="\"$segmenter\" {image} {mask}"
echo 0 >"$work/count"
run mask "$capture" --command "$line" --json
expect_code 0 'mask --command'
[ "$(head -c 1 "$work/stdout")" = '{' ] || fail 'mask --command --json: something before the document'
grep -q chatter "$work/stdout" && fail 'mask --command: the program speaks on our standard output'
[ -s "$capture/masks/cam2/000059.png" ] || fail 'mask --command: no last mask'
[ -z "$(ls "$TMPDIR")" ] || fail 'mask --command: something is left in TMPDIR'
run check "$capture"
expect_code 0 'check after mask'
echo 0 >"$work/count"
FRAMES=4 run mask "$demo" -o "$work/same" --frames 0:4 --command "$line"
expect_output '^cam2: IoU 1\.0000' 'mask --command: the masks are what the program wrote'

# what goes wrong is said with camera and frame
attempt() {  # pattern line
  FRAMES=60 expect_error 1 "$1" mask "$demo" -o "$work/attempt" --force --command "$2"
}
export FAIL_AT=2
echo 0 >"$work/count"
run mask "$demo" -o "$work/attempt" --frames 0:5 --command "$line"
expect_code 1 'a command that fails'
grep -q '^chainsplat: error: cam0, frame 2: the command failed with exit code 3; ' "$work/stderr" ||
  fail 'a command that fails: the frame is not named'
attempt 'cam0, frame 0: the command wrote no mask' ': {image} {mask}'
attempt 'cam0, frame 0: .*no image' 'echo nonsense >{mask}; : {image}'
base64 -d >"$work/small.png" <<<'iVBORw0KGgoAAAANSUhEUgAAAAgAAAAICAAAAADhZOFXAAAADElEQVR42mNgoA4AAABIAAEQRe/SAAAAAElFTkSuQmCC'
attempt 'cam0, frame 0: .*8x8 pixels.*320x240' "cp '$work/small.png' {mask}; : {image}"
# a folder that is called like the place of a file in the line
mkdir "$work/{mask}{image}"
echo 0 >"$work/count"
TMPDIR="$work/{mask}{image}" FRAMES=4 FAIL_AT=none run mask "$demo" -o "$work/named" --frames 0:4 --command "$line"
expect_code 0 'a TMPDIR that is called {mask}'
expect_output '^cam2: IoU 1\.0000' 'a TMPDIR that is called {mask}'

# no mask is written or read through a link that leads out of the capture
mkdir "$work/victim"
bare
ln -s "$work/victim" "$capture/masks"
expect_error 2 'its folder .*/masks is a link out of .*/capture, to .*/victim; ' mask "$capture" --command "$line"
rm "$capture/masks"
mkdir -p "$capture/masks"
ln -s "$work/victim" "$capture/masks/cam1"
expect_error 2 'masks/cam1 is a link out of' mask "$capture"
mkdir "$work/led"
ln -s "$work/victim" "$work/led/cam0"
expect_error 2 'led/cam0 is a link out of' mask "$demo" -o "$work/led" --force
[ -z "$(ls "$work/victim")" ] || fail 'mask: written through a link'
bare
mkdir "$capture/inside"
ln -s inside "$capture/masks"
echo 0 >"$work/count"
FRAMES=60 FAIL_AT=none run mask "$capture" --command "$line"
expect_code 0 'masks by a link inside the capture'
[ -s "$capture/inside/cam2/000059.png" ] || fail 'masks by a link inside the capture: no last mask'

# a rope of 2,000 diameters is not there, which a few frames tell as well as all of them
bare
sed -i 's/"length": [0-9.]*/"length": 2/; s/"diameter": [0-9.]*/"diameter": 0.001/' "$capture/capture.json"
expect_error 2 'nothing like the rope|behind' mask "$capture" -o "$work/thin" --frames 0:12

expect_error 2 '--command.*\{mask\}' mask "$demo" -o "$work/attempt" --command 'segment {image}'
finish
