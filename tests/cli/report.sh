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
check wide '"images":true' 'sections":"replay,verdict,metrics,angles,overlap,identified'
python3 "$(dirname "$0")/report_pictures.py" "$work/wide.dom" "$work/frames" 45 40 || fail 'the page draws other pictures than render'
drive "$work/video.html" phone 400 11
check phone '"images":true'

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
