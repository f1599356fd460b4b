#!/bin/bash
# A capture whose length and base clock are given wrongly: check and train say so, the twin is made as if they were right,
# and everything that loads the capture again goes by what was found.
. "$(dirname "$0")/lib.sh"
demo=$source_dir/assets/demo_free_30
cp -r "$demo" "$work/capture"
chmod -R u+w "$work/capture"
rm -f "$work/capture/truth/"*  # the truth is of the right length

python3 - "$work/capture" <<'END'
import json, pathlib, sys
folder = pathlib.Path(sys.argv[1])
capture = json.loads((folder / "capture.json").read_text())
capture["object"]["length"] *= 0.97
(folder / "capture.json").write_text(json.dumps(capture))
END

verdict() {  # file, code: prints value and whether it was corrected
  python3 - "$1" "$2" <<'END'
import json, sys
document = json.load(open(sys.argv[1]))
for finding in document["verdict"]:
    if finding["code"] == sys.argv[2]:
        print(finding["value"], finding["corrected"], finding["trusted"])
END
}

run check "$demo"
expect_code 0 'check of a right capture'
grep -q 'Nothing is wrong' "$work/stdout" || fail 'check finds something wrong with the demo'

run --json check "$work/capture"
expect_code 0 'check of a short rope'
cp "$work/stdout" "$work/check.json"
read -r value corrected trusted < <(verdict "$work/check.json" length)
python3 -c "import sys; sys.exit(not 2.0 < float('${value:-0}') < 4.0)" || fail "check says length ${value:-nothing}"
[ "$corrected $trusted" = 'True True' ] || fail "check says corrected $corrected, trusted $trusted"

run train "$work/capture" -o "$work/run" -q
expect_code 0 'train of a short rope'
grep -q 'the rope is .* longer than 0.' "$work/stdout" || fail 'train does not say that the rope is longer'
python3 - "$work/run/twin.json" <<'END' || fail 'twin.json does not hold the corrected length'
import json, sys
twin = json.load(open(sys.argv[1]))
given = 0.97 * 0.3
found = twin["corrections"]["object"]["length"]
assert abs(twin["chain"]["length"] - given - found["value"]) < 1e-9, twin["chain"]["length"]
assert abs(twin["chain"]["length"] - 0.3) < 0.003 and found["state"] == "free" and found["sigma"] > 0
assert twin["trusted"] is True
assert twin["corrections"]["cameras"]["cam0"]["rotation"]["value"].__len__() == 3
END

# evaluated again from the files, the pictures are drawn through the same corrected cameras
run --json eval "$work/run" "$work/capture"
expect_code 0 'eval of the corrected twin'
cp "$work/stdout" "$work/eval.json"
python3 - "$work/run/metrics.json" "$work/eval.json" <<'END' || fail 'eval differs from what train measured'
import json, sys
trained, again = (json.load(open(file)) for file in sys.argv[1:3])
for part in ("recognized", "rollout"):
    for name, value in trained[part]["mean"].items():
        assert abs(again[part]["mean"][name] - value) < 1e-6 * max(1.0, abs(value)), (part, name)
END

run recognize "$work/capture" -o "$work/fixed" --fixed all -q
expect_code 0 'recognize with everything fixed'
python3 -c "
import json; twin = json.load(open('$work/fixed/twin.json'))
assert 'corrections' not in twin and abs(twin['chain']['length'] - 0.291) < 1e-9" || fail 'with --fixed all the length changed'
# what is held is looked at all the same
[ "$(verdict "$work/fixed/twin.json" length | cut -d' ' -f2-)" = 'False False' ] ||
  fail 'a twin of a wrong length that was held is trusted'
grep -q 'held as given' "$work/stdout" || fail 'recognize --fixed all does not say what it holds wrongly'
run recognize "$work/capture" -o "$work/no" --fixed camera
expect_code 2 'a group that is none'
finish
