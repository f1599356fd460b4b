#!/bin/bash
# The page of a run: written by train and by report, the same pictures as render's in a real browser without a screen,
# controls that work, on a phone's width too, no error, and names that stay text. The browser's part is skipped (77) where
# there is no chromium.
. "$(dirname "$0")/lib.sh"
demo=$source_dir/assets/demo_free_30
browser=$(command -v chromium || command -v chromium-browser || command -v google-chrome) || browser=
run train "$demo" -o "$work/run" --joints 3 --frames 0:24
expect_code 0 train
page=$work/run/report.html
[ -s "$page" ] || fail 'train: no report.html'
[ "$(wc -c <"$page")" -lt 700000 ] || fail "the page has $(wc -c <"$page") bytes"

# the same page again; with a video; without the capture
run report "$work/run" -o "$work/again.html"
expect_code 0 report
cmp -s "$page" "$work/again.html" || fail 'report: another page than that of train'
run report "$work/run" -o "$work/video.html" --video cam1 --json
expect_code 0 'report --video'
expect_output '"output":' 'report --video --json'
grep -q '"camera":"cam1"' "$work/video.html" || fail 'report --video: no video'
expect_error 2 'no camera' report "$work/run" -o "$work/no.html" --video cam9
[ -e "$work/no.html" ] && fail 'report --video of no camera: wrote a page'
cp -r "$work/run" "$work/moved"
sed -i 's|"path":"[^"]*"|"path":"nowhere"|; s|"path": "[^"]*"|"path": "nowhere"|' "$work/moved/twin.json"
run report "$work/moved" -o "$work/alone.html"
expect_code 0 'report without the capture'
grep -q 'shows no cameras' "$work/stderr" || fail 'report without the capture: does not say so'
run report "$work/moved" -o "$work/alone.html" --capture "$demo"
cmp -s "$work/alone.html" "$page" || fail 'report --capture: another page'
echo '{"recognized": 3}' >"$work/moved/metrics.json"
expect_error 2 'metrics.json: is damaged' report "$work/moved" -o "$work/no.html"
expect_error 2 'its folder does not exist' report "$work/run" -o "$work/none/no.html"

# identify takes the metrics away, and the page is written anew without them
cp -r "$work/run" "$work/anew"
run identify "$work/anew"
expect_code 0 identify
cmp -s "$work/anew/report.html" "$page" && fail 'identify: the page still has the metrics of before'

# where the capture is another one by now, what was identified is not lost
cp -r "$work/anew" "$work/elsewhere"
cp -r "$demo" "$work/other_capture"
chmod -R u+w "$work/other_capture"
sed -i 's|"path":"[^"]*"|"path":"../other_capture"|; s|"path": "[^"]*"|"path": "../other_capture"|' "$work/elsewhere/twin.json"
echo >>"$work/other_capture/capture.json"
run identify "$work/elsewhere"
expect_code 0 'identify, another capture'
grep -q 'has changed since.*shows no cameras' "$work/stderr" || fail 'identify, another capture: does not say so'

# what was followed, with four frames that are lost, and what pushed it: nothing did, so a line of force is made into a push
run estimate "$work/run" --camera "$demo:cam0"
expect_code 0 estimate
python3 - "$work/stdout" "$work/lines.jsonl" <<'PYTHON'
import json, sys
lines = [json.loads(line) for line in open(sys.argv[1])][:24]
for line in lines:
    line.update(settling=False, lost=5 <= line["frame"] < 9, status="lost" if 5 <= line["frame"] < 9 else "following")
open(sys.argv[2], "w").writelines(json.dumps(line) + "\n" for line in lines)
PYTHON
run force "$work/run" --estimate "$work/lines.jsonl"
expect_code 0 force
python3 - "$work/stdout" "$work/forces.jsonl" <<'PYTHON'
import json, sys
lines = [json.loads(line) for line in open(sys.argv[1])]
for line in lines:
    line["touching"] = False
lines[8].update(touching=True, probability=0.99, force=[0.3, 0.0, 0.1], low=[0.3, 0.0, 0.1], high=[0.3, 0.0, 0.1],
                 sigma=[0.03, 0.2, 0.04], covariance=[0.0009, 0.001, 0.04, 0, 0, 0.0016], arclength=0.2, arclength_sigma=0.01)
open(sys.argv[2], "w").writelines(json.dumps(line) + "\n" for line in lines)
PYTHON
streams=(--estimate "$work/lines.jsonl" --forces "$work/forces.jsonl")
run report "$work/run" -o "$work/followed.html" "${streams[@]}" --video cam1
expect_code 0 'report --estimate --forces'
grep -q 'warning: --base: is missing' "$work/stderr" || fail 'report --estimate without --base: does not say what it takes'
run report "$work/run" -o "$work/estimate.html" --estimate - --base "$demo/base.tum"
expect_code 2 'report --estimate of an empty standard input'
"$program" -q report "$work/run" -o "$work/estimate.html" --estimate - --base "$demo/base.tum" <"$work/lines.jsonl" ||
  fail 'report --estimate -'
grep -q '"name":"followed".*"own":true' "$work/estimate.html" || fail 'report --base: its own recording counts as another'
# another recording: later, and its base elsewhere
python3 - "$demo/base.tum" "$work/base.tum" "$work" <<'PYTHON'
import json, sys
rows = [line.split() for line in open(sys.argv[1]) if line.strip() and line[0] != "#"]
open(sys.argv[2], "w").writelines(" ".join([repr(float(r[0]) + 1000), repr(float(r[1]) + 1), *r[2:]]) + "\n" for r in rows)
for name in "lines", "forces":
    lines = [json.loads(line) for line in open(f"{sys.argv[3]}/{name}.jsonl")]
    for line in lines:
        line["time"] += 1000
        if "point" in line:
            line["point"][0] += 1
    open(f"{sys.argv[3]}/{name}_later.jsonl", "w").writelines(json.dumps(line) + "\n" for line in lines)
PYTHON
later=(--estimate "$work/lines_later.jsonl" --forces "$work/forces_later.jsonl")
run report "$work/run" -o "$work/apart.html" "${later[@]}" --base "$work/base.tum" --video cam1
expect_code 0 'report of another recording'
expect_error 2 'run: the base motion covers .*--base' report "$work/run" -o "$work/no.html" "${later[@]}"

# what does not belong together
expect_error 2 '--forces: no --estimate' report "$work/run" -o "$work/no.html" --forces "$work/forces.jsonl"
expect_error 2 '--base: no --estimate' report "$work/run" -o "$work/no.html" --base "$demo/base.tum"
expect_error 2 'more than one is standard input' report "$work/run" -o "$work/no.html" --estimate - --forces -
expect_error 2 'would be overwritten' report "$work/run" -o "$work/lines.jsonl" "${streams[@]}"
expect_error 2 'would be overwritten' report "$work/run" -o "$work/run/twin.json"
expect_error 2 '--json: standard output is wanted' report "$work/run" -o - --json
expect_error 2 'forces_later.jsonl: line 1: time: 1000.* is no time of the estimates' report "$work/run" -o "$work/no.html" \
  --estimate "$work/lines.jsonl" --forces "$work/forces_later.jsonl"
expect_error 2 "lines.jsonl: line 1: is no line of 'chainsplat force'|lines.jsonl: line 1: link: is missing" report "$work/run" \
  -o "$work/no.html" --estimate "$work/lines.jsonl" --forces "$work/lines.jsonl"
: >"$work/empty.jsonl"
expect_error 2 'empty.jsonl: has no line' report "$work/run" -o "$work/no.html" --estimate "$work/lines.jsonl" --forces "$work/empty.jsonl"
expect_error 2 'empty.jsonl: has no frame' report "$work/run" -o "$work/no.html" --estimate "$work/empty.jsonl"
sed '2s/"theta": \[[^,]*,/"theta": [/' "$work/lines.jsonl" >"$work/bad.jsonl"
expect_error 2 'bad.jsonl: line 2: theta: has .* angles, the twin' report "$work/run" -o "$work/no.html" --estimate "$work/bad.jsonl"
bad_force() {  # sed's command for the third line, pattern
  sed "3$1" "$work/forces.jsonl" >"$work/bad.jsonl"
  expect_error 2 "bad.jsonl: line 3: $2" report "$work/run" -o "$work/no.html" --estimate "$work/lines.jsonl" --forces "$work/bad.jsonl"
}
bad_force 's/"covariance": \[[^,]*/"covariance": [-1/' 'covariance: is not positive semidefinite'
bad_force 's/"force": \[[^,]*/"force": [NaN/' "is no line of 'chainsplat force'"
bad_force 's/"link": [0-9]*/"link": 4/' 'link: 4 is not from 0 to 3'
bad_force 's/"unit": "N"/"unit": "N\/kg"/' "unit: is N/kg, but the twin's mass is known"
[ -e "$work/no.html" ] && fail 'report of what does not belong together: wrote a page'

if [ -z "$browser" ]; then
  [ "$failures" -eq 0 ] || finish
  echo 'skipped: there is no chromium'
  exit 77
fi

# A copy of the page with errors watched from its begin and the driver at its end.
drive() {  # page, name, width, frames
  python3 - "$1" "$work/$2.html" "$(dirname "$0")/report_driver.js" "$4" <<'PYTHON'
import sys
page, driver = open(sys.argv[1], encoding='utf-8').read(), open(sys.argv[3]).read()
watch = ("<script>window.errors = []; addEventListener('error', e => errors.push(e.message));"
         "console.error = console.warn = (...all) => errors.push(all.join(' '));"
         "addEventListener('securitypolicyviolation', e => errors.push('policy: ' + e.blockedURI));</script>\n")
page = page.replace('<style>', watch + '<style>', 1)
place = page.rindex('</body>')
page = page[:place] + '<script>' + driver + f'drive([{sys.argv[4]}]);</script>\n' + page[place:]
open(sys.argv[2], 'w', encoding='utf-8').write(page)
PYTHON
  timeout 300 "$browser" --headless --no-sandbox --user-data-dir="$work/profile" --window-size="$3",900 \
    --virtual-time-budget=8000 --dump-dom "file://$work/$2.html" >"$work/$2.dom" 2>/dev/null
  grep -q 'data-checks=' "$work/$2.dom" || fail "$2: the page did not come to its end"
}
check() {  # name, what must be in it...
  local checks
  checks=$(grep -o 'data-checks="[^"]*"' "$work/$1.dom" | sed 's/&quot;/"/g')
  for what in '"slider":true' '"play":true' '"stop":true' '"orbit":true' '"width":true' '"errors":\[\]' "${@:2}"; do
    echo "$checks" | grep -q -- "$what" || fail "$1: not $what in $checks"
  done
}

run render "$work/run" --states "$work/run/rollout.csv" --camera "$demo" -o "$work/frames" --mask
expect_code 0 render
drive "$page" wide 1200 2,11,20
check wide '"images":true' '"hatch":true' 'sections":"replay,verdict,metrics,angles,overlap,identified'
python3 "$(dirname "$0")/report_pictures.py" "$work/wide.dom" "$work/frames" 45 40 || fail 'the page draws other pictures than render'
drive "$work/video.html" phone 400 11
check phone '"images":true'

# what was followed: a force where it pushes, on a phone, too; videos beside it only where they are of the same recording
for width in 1200 400; do
  drive "$work/followed.html" "followed_$width" "$width" 11
  check "followed_$width" '"followed":true' '"apart":false' '"videos":true' '"lost":true' '"beyond":true' '"arrow":true' '"no_arrow":true' '"plot":true' \
    '"largest":"Largest force from outside: 0.316 ± 0.031 N at 0.40 s, 0.200 ± 0.010 m from the grasp' '"about":"20 frames from 0.00 to 0.77 s, interrupted once\.L'
done
drive "$work/apart.html" apart 1000 11
check apart '"followed":true' '"apart":true' '"videos":false' '"beyond":true' '"arrow":true' '"no_arrow":true' '"about":"20 frames from 1000.00 to 1000.77 s, interrupted once; of another'
drive "$work/estimate.html" estimate 1000 11
check estimate '"followed":true' '"apart":false' '"beyond":true'
sed 's/"touching": true/"touching": false/' "$work/forces.jsonl" >"$work/calm.jsonl"
run report "$work/run" -o "$work/calm.html" --estimate "$work/lines.jsonl" --forces "$work/calm.jsonl"
expect_code 0 'report of forces that touch nothing'
drive "$work/calm.html" calm 1000 11
check calm '"followed":true' '"arrow":"none"' '"no_arrow":true' '"plot":true' '"about":".*Nothing touched the rope\.'

# one moment alone, as a link asks for it, pixel by pixel on the screen
timeout 300 "$browser" --headless --no-sandbox --user-data-dir="$work/profile" --hide-scrollbars --window-size=320,240 \
  --virtual-time-budget=3000 --screenshot="$work/moment.png" \
  "file://$page#camera=cam2&time=0.36666667&plain" 2>/dev/null
python3 "$(dirname "$0")/report_pictures.py" "$work/moment.png" "$work/frames/cam2/000011.png" 45 ||
  fail 'a link to a moment shows another picture than render'

# names are text, whatever they say
sed -i 's|"capture": "demo_free_30"|"capture": "</script><img src=x onerror=errors.push(1)><b>name"|; s|"capture":"demo_free_30"|"capture":"</script><img src=x onerror=errors.push(1)><b>name"|' "$work/anew/twin.json"
grep -q '<b>name' "$work/anew/twin.json" || fail 'the test could not change the name'
run report "$work/anew" -o "$work/named.html"
expect_code 0 'report of a name with markup'
drive "$work/named.html" markup 1000 2
check markup '"images":true' '"title":"[^"]*/script&gt;&lt;img\|"title":".*<b>name'
finish
