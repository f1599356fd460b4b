#!/bin/bash
# Captures that are wrong in one way each: one clear line, exit code 2, nothing written. No Vulkan device is needed.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
demo=$source_dir/assets/demo_free_30
capture=$work/capture
out=$work/run

fresh() {  # an unharmed copy
  rm -rf "$capture"
  cp -r "$demo" "$capture"
  rm -rf "$capture/depth" "$capture/truth"
  sed -i '/"depth/d; s/"masks": \(.*\),$/"masks": \1,/' "$capture/capture.json"
}

refused() {  # pattern: of the error line
  expect_error 2 "$1" train "$capture" -o "$out" --frames 0:12
  [ -e "$out" ] && fail "$1: something was written" && rm -rf "$out"
}

# pictures of our own, so that no tool is needed to make them
black_8x8() {
  base64 -d <<<'iVBORw0KGgoAAAANSUhEUgAAAAgAAAAICAAAAADhZOFXAAAADElEQVR42mNgoA4AAABIAAEQRe/SAAAAAElFTkSuQmCC'
}
black_320x240() {
  base64 -d <<<'iVBORw0KGgoAAAANSUhEUgAAAUAAAADwCAAAAABURuK3AAAAYklEQVR42u3BMQEAAADCoPVPbQ0PoAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA4NcALP8AAZ8iU1IAAAAASUVORK5CYII='
}

# the unharmed one gets as far as the device
fresh
refused 'Vulkan'

rm -r "$capture"
refused 'capture'

fresh; rm "$capture/capture.json"
refused 'capture\.json'
fresh; head -c 300 "$demo/capture.json" >"$capture/capture.json"
refused 'capture\.json'
fresh; sed -i 's|"chainsplat-capture/1"|"chainsplat-capture/9"|' "$capture/capture.json"
refused 'format'

# images and masks
fresh; rm "$capture/cam1.mp4"
refused 'cam1\.mp4'
fresh; head -c 2000 "$demo/cam1.mp4" >"$capture/cam1.mp4"
refused 'cam1\.mp4'
fresh; rm "$capture/masks/cam2/000004.png"
refused 'cam2/000004\.png'
fresh; head -c 60 "$demo/masks/cam2/000004.png" >"$capture/masks/cam2/000004.png"
refused 'cam2/000004\.png'
fresh; black_8x8 >"$capture/masks/cam0/000003.png"
refused 'cam0/000003\.png.*(8 ?x ?8|size)'
fresh; for mask in "$capture"/masks/*/*.png; do black_320x240 >"$mask"; done
refused 'cam0 never sees the object'
fresh; for mask in "$capture"/masks/cam2/*.png; do black_320x240 >"$mask"; done
refused 'cam2 never sees the object'

# the base
fresh; rm "$capture/base.tum"
refused 'base\.tum'
fresh; head -n 20 "$demo/base.tum" >"$capture/base.tum"
refused 'base\.tum'
fresh; sed -i '10s/ [^ ]* / nan /' "$capture/base.tum"
refused 'base\.tum.*10'
fresh; sed -i '10s/ [^ ]* / inf /' "$capture/base.tum"
refused 'base\.tum.*10'
fresh; sed -i '10s/ .*//' "$capture/base.tum"
refused 'base\.tum.*10'
fresh; { sed -n '1,9p;12p' "$demo/base.tum"; sed -n '10,$p' "$demo/base.tum"; } >"$capture/base.tum"
refused 'base\.tum'

# numbers
fresh; sed -i 's/"length": 0\.3/"length": 0/' "$capture/capture.json"
refused 'length'
fresh; sed -i 's/"length": 0\.3/"length": NaN/' "$capture/capture.json"
refused 'capture\.json'
fresh; sed -i 's/"length": 0\.3/"length": -0.3/' "$capture/capture.json"
refused 'length'
fresh; sed -i '0,/"fx": [0-9.]*/s//"fx": 0/' "$capture/capture.json"
refused 'fx'
fresh; sed -i 's|"base": "base.tum"|"base": "../base.tum"|' "$capture/capture.json"
refused 'base'

# what only evaluation reads: found before the work, and no matter where nothing is evaluated
fresh; cp -r "$demo/truth" "$capture/"
refused 'Vulkan'
sed -i '1s/.*/t,x,y,z/' "$capture/truth/centreline.csv"
refused 'truth/centreline\.csv:1: is not the header'
expect_error 2 'Vulkan' recognize "$capture" -o "$out" --frames 0:12
run check "$capture"
expect_code 2 'check, a wrong truth'
expect_output '^problem: .*centreline\.csv:1' 'check, a wrong truth'
cp "$demo/truth/centreline.csv" "$capture/truth/"
sed -i '5s/.*/3,nan,1/' "$capture/truth/centreline.csv"
refused 'centreline\.csv:5'
rm -r "$capture"; cp -r "$demo" "$capture"
black_8x8 >"$capture/depth/cam1/000007.png"
refused 'depth/cam1/000007\.png: is 8x8 pixels'

# too few frames for identification, not for recognition
expect_error 2 '--frames: identification needs 3 frames of cam0 or more, and there are 2' train "$demo" -o "$out" --frames 0:2 --stages recognize,identify
[ -e "$out" ] && fail 'too few frames: something was written'
expect_error 2 'Vulkan' recognize "$demo" -o "$out" --frames 0:2

# results never go into the capture itself
fresh
before=$(cd "$capture" && find . -type f | sort)
expect_error 2 "is the capture's own folder" train "$capture" -o "$capture" --frames 0:12 --force
[ "$before" = "$(cd "$capture" && find . -type f | sort)" ] || fail 'train into the capture: its files changed'

# nothing to resume, but files of somebody else
mkdir "$out" && echo mine >"$out/base.tum"
expect_error 2 'holds no run to resume' train "$demo" -o "$out" --frames 0:12 --resume
[ "$(cat "$out/base.tum")" = mine ] || fail 'train --resume: wrote over a file that is not its own'
rm -r "$out"

# frames that are not there
expect_error 2 'frames' train "$demo" -o "$out" --frames 400:500

# an unknown key and a single camera are doubts: a warning that names them, and on it goes to the device
fresh; sed -i 's/"base": /"colour": 1, "base": /' "$capture/capture.json"
refused 'Vulkan'
grep -q '^chainsplat: warning: .*colour' "$work/stderr" || fail 'an unknown key: no warning that names it'
run check "$capture"
expect_code 0 'check, an unknown key'
expect_output '^doubt: .*colour' 'check, an unknown key'
fresh; awk '/"cam1"/ { exit } { print }' "$capture/capture.json" | sed '$d' | sed '$s/},/}/' >"$work/one.json"
echo ' ]}' >>"$work/one.json"
mv "$work/one.json" "$capture/capture.json"
refused 'Vulkan'
grep -q '^chainsplat: warning: .*only one' "$work/stderr" || fail 'one camera: no warning'

# a rate that would make a day of one frame, and a length of time that would be integrated in milliseconds
fresh; sed -i '0,/"rate": [0-9.]*/s//"rate": 1e-7/' "$capture/capture.json"
refused 'rate: 1e-07 is not between'
fresh; echo '1e7 0 0 1 0 0 0 1' >>"$capture/base.tum"
refused 'base\.tum: pose .* a motion lasts at most 86400 s'
# what is no trunk for LPIPS: found before anything else is read
trunks=$source_dir/tests/data/lpips
not_a_trunk() {  # pattern file
  expect_error 2 "$1" eval "$work/nowhere" "$demo" --lpips "$2" -o "$work/metrics.json"
  [ -e "$work/metrics.json" ] && fail "$1: something was written"
}
not_a_trunk 'missing\.onnx: No such file' "$work/missing.onnx"
not_a_trunk 'is a folder' "$work"
head -c 5000 "$demo/cam1.mp4" >"$work/garbage.onnx"
not_a_trunk 'garbage\.onnx: is no network' "$work/garbage.onnx"
head -c 9000 "$trunks/trunk.onnx" >"$work/cut.onnx"
not_a_trunk 'cut\.onnx: is no network' "$work/cut.onnx"
not_a_trunk 'one_output\.onnx: has 1 output, not the features of five layers; make it with tools/lpips_trunk' "$trunks/one_output.onnx"
not_a_trunk 'channels\.onnx: has features of 3, 3, 3, 3, 3 channels' "$trunks/channels.onnx"
not_a_trunk 'nowhere' "$trunks/trunk.onnx"

twin=$source_dir/tests/data/planning/free
expect_error 2 '--rate: .* 1000000 rows' rollout "$twin" --initial "$twin/states.csv" -o "$work/states.csv" --rate 99999999999
expect_error 2 '--rate: .* 1000000 rows' plan "$twin" --target 0.1,0,0.3 -o "$work/plan" --rate 99999999999
expect_error 2 '--horizon: .* 120 s' plan "$twin" --target 0.1,0,0.3 -o "$work/plan" --horizon 1e7
expect_error 2 '--mpc-rate: .* 1000' plan "$twin" --target 0.1,0,0.3 -o "$work/plan" --mpc-rate 1e12
expect_error 2 '--rate: .* 1000000 rows' excite "$twin" -o "$work/motion" --rate 99999999999
expect_error 2 '--frame-rate: .* 100000 frames' excite "$twin" -o "$work/motion" --frame-rate 1e9
expect_error 2 '--gaussians: .* 2000000' bench --gaussians 2000000000
expect_error 2 '--views: .* 1000' bench --views 2000000000
expect_error 2 '--repeats' bench --repeats 2000000000
python3 - "$demo/capture.json" "$work/camera.json" <<'E1'
import json, sys
camera = json.load(open(sys.argv[1]))["cameras"][0]
camera["rate"] = 1e-7
json.dump(camera, open(sys.argv[2], "w"))
E1
make_straight_twin "$work/straight" "$demo"
expect_error 2 'camera\.json: rate: 1e-07 is not between' estimate "$work/straight" --camera - --calibration "$work/camera.json"

# brackets in brackets: whatever is read as JSON is refused in a line, long before the stack is full
deep() { head -c 200000 /dev/zero | tr '\0' '['; echo; }
fresh; deep >"$capture/capture.json"
refused 'capture\.json.*JSON'
deep >"$work/deep.json"
expect_error 2 'deep\.json.*JSON' estimate "$work/straight" --camera - --calibration "$work/deep.json"
expect_error 2 'deep\.json.*JSON' plan "$twin" --target 0.1,0,0.3 -o "$work/plan" --simulate "$work/deep.json"
expect_error 2 'deep\.json.*estimate' force "$twin" --estimate "$work/deep.json" --base "$demo/base.tum"
cp -r "$twin" "$work/online"
expect_error 2 'deep\.json.*estimate' identify "$work/online" --online "$work/deep.json" --base "$demo/base.tum"
mkdir "$work/deep"
deep >"$work/deep/twin.json"
expect_error 2 'twin\.json' rollout "$work/deep" -o "$work/states.csv"
expect_error 2 'twin\.json' diff "$work/deep" "$work/straight"
cp -r "$work/straight" "$work/metrics"
deep >"$work/metrics/metrics.json"
expect_error 2 'metrics\.json' diff "$work/metrics" "$work/straight"

# what the files hold never reaches the terminal raw
fresh; printf '{"format": "a\033[31m\001\\u0000z"}' >"$capture/capture.json"
refused 'capture\.json'
fresh; python3 - "$capture/capture.json" <<'E1'
import json, sys
capture = json.load(open(sys.argv[1]))
capture["name"] = "red \x1b[31m bell \x07 null \x00 end"
capture["k\x1b[2J\x00"] = 1
capture["cameras"][0]["name"] = "c\x1b[31m\x00"
json.dump(capture, open(sys.argv[1], "w"))
E1
refused 'cannot name a folder'
run check "$capture"
expect_code 2 'check, control characters'
expect_output 'problem: .*c.x1b\[31m.x00' 'check, control characters'
expect_output "^capture 'red .x1b\[31m bell .x07 null " 'check, control characters'
fresh; python3 - "$capture/capture.json" <<'E1'
import json, sys
capture = json.load(open(sys.argv[1]))
capture["k\x1b[2J\x00"] = 1
json.dump(capture, open(sys.argv[1], "w"))
E1
refused 'Vulkan'
grep -q 'warning: .*k.x1b\[2J.x00: unknown key' "$work/stderr" || fail 'a key with control characters: no warning that shows them'
cat "$work/stdout" "$work/stderr" | grep -q "$(printf '\033')" && fail 'control characters: they reach the terminal'
run check "$work/$(printf 'no\033[31m\377folder')"
expect_code 2 'check of a name that is no text'
grep -q 'error: .*no.x1b\[31m.xfffolder: ' "$work/stderr" || fail 'check of a name that is no text: not escaped'
run check "$work/$(printf 'no\377folder')" --json
expect_code 2 'check --json of a name that is no text'
[ "$(head -c 1 "$work/stdout")" = '{' ] || fail 'check --json of a name that is no text: no document'

# pipes, which never end, and a capture that is reached by a link or left by one
fresh; rm "$capture/base.tum"; mkfifo "$capture/base.tum"
refused 'base\.tum: is a pipe'
fresh; rm "$capture/cam0.mp4"; mkfifo "$capture/cam0.mp4"
refused 'cam0\.mp4: is a pipe'
fresh; rm "$capture/capture.json"; mkfifo "$capture/capture.json"
refused 'capture\.json: is a pipe'
fresh; rm "$capture/masks/cam0/000000.png"; mkfifo "$capture/masks/cam0/000000.png"
refused 'cam0/000000\.png'
fresh; ln -sf /dev/zero "$capture/base.tum"
refused 'base\.tum: is a link out of .*/dev/zero'
fresh; mv "$capture/cam0.mp4" "$work/elsewhere.mp4"; ln -s "$work/elsewhere.mp4" "$capture/cam0.mp4"
refused "cam0\\.mp4: is a link out of .*, to .*/elsewhere\\.mp4; copy the file"
printf '#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:2\n#EXTINF:2.0,\n%s\n#EXT-X-ENDLIST\n' "$work/elsewhere.mp4" >"$work/list"
fresh; cp "$work/list" "$capture/cam0.mp4"
refused 'cam0\.mp4: is not a readable video'
fresh; ln -s "$capture" "$work/way"
expect_error 2 Vulkan train "$work/way" -o "$out" --frames 0:12

# check tells the same in plain words
fresh; rm "$capture/cam1.mp4"
run check "$capture"
expect_code 2 'check, a missing video'
expect_output '^problem: .*cam1\.mp4' 'check, a missing video'
run check "$demo"
expect_code 0 'check'
expect_output 'cam2' 'check'

# where the result would go
mkdir "$out" && touch "$out/something"
expect_error 2 'not empty.*--force' train "$demo" -o "$out"
[ "$(ls "$out")" = something ] || fail 'a run folder that is not empty: something was written'
expect_error 2 'is a file' train "$demo" -o "$out/something"
finish
