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
expect_error 2 '--frames: identification needs 3 frames of cam0 or more, and there are 2' train "$demo" -o "$out" --frames 0:2
[ -e "$out" ] && fail 'too few frames: something was written'
expect_error 2 'Vulkan' recognize "$demo" -o "$out" --frames 0:2

# results never go into the capture itself
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
