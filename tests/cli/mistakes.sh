#!/bin/bash
# Mistakes that people make when they write a capture: check names each, and train stops before the work.
. "$(dirname "$0")/lib.sh"
demo=$source_dir/assets/demo_free_30

wrong() {  # name, Python that changes `capture` (a dict) and `base` (rows of numbers)
  mkdir -p "$work/$1"
  cp -r "$demo/." "$work/$1"
  chmod -R u+w "$work/$1"
  python3 - "$work/$1" "$2" <<'END' || fail "$1: cannot be made"
import json, pathlib, sys
folder = pathlib.Path(sys.argv[1])
capture = json.loads((folder / "capture.json").read_text())
base = [[float(x) for x in line.split()] for line in (folder / "base.tum").read_text().splitlines() if line and line[0] != "#"]

def inverse(m):
    r = [[m[j][i] for j in range(3)] for i in range(3)]
    t = [-sum(r[i][k] * m[k][3] for k in range(3)) for i in range(3)]
    return [r[i] + [t[i]] for i in range(3)] + [[0, 0, 0, 1]]

def opengl(m):
    return [[row[0], -row[1], -row[2], row[3]] for row in m[:3]] + [m[3]]

def each(change, cameras=None):
    for camera in capture["cameras"] if cameras is None else [capture["cameras"][c] for c in cameras]:
        flat = camera["world_from_camera"]
        changed = change([flat[4 * i:4 * i + 4] for i in range(4)])
        camera["world_from_camera"] = [x for row in changed for x in row]

def millimeters(m):
    return [row[:3] + [1e3 * row[3]] for row in m[:3]] + [m[3]]

exec(sys.argv[2])
(folder / "capture.json").write_text(json.dumps(capture))
(folder / "base.tum").write_text("".join(" ".join(repr(x) for x in row) + "\n" for row in base))
END
}

expect_finding() {  # name, code, subject
  run --json check "$work/$1"
  expect_code 2 "check of $1"
  cp "$work/stdout" "$work/found.json"
  python3 - "$work/found.json" "$2" "$3" <<'END' || fail "$1: check does not name $2 of $3: $(tr '\n' ' ' <"$work/found.json" | grep -o '"verdict".*' | cut -c1-300)"
import json, sys
found = json.load(open(sys.argv[1]))
assert any(f["code"] == sys.argv[2] and f["subject"] == sys.argv[3] and not f["trusted"] for f in found["verdict"])
assert not found["usable"] and not found["trusted"]
END
  rm -rf "${work:?}/$1"
}

wrong inverse 'each(inverse)'
run train "$work/inverse" -o "$work/run" -q
expect_code 2 'train with inverse poses'
grep -q 'write its inverse' "$work/stderr" || fail 'train does not say what is wrong with the poses'
[ -e "$work/run" ] && fail 'train left a run folder of a capture that contradicts itself'
expect_finding inverse inverse-pose cameras
wrong opengl 'each(opengl)' && expect_finding opengl opengl-axes cameras
wrong both 'each(lambda m: inverse(opengl(m)))' && expect_finding both inverse-pose cameras
wrong one 'each(inverse, [1])' && expect_finding one inverse-pose cam1
wrong far 'each(millimeters)' && expect_finding far units cameras
wrong base 'base = [[r[0]] + [1e3 * x for x in r[1:4]] + r[4:] for r in base]' && expect_finding base units base
wrong rope 'capture["object"] = {"length": 30.0, "diameter": 2.0}' && expect_finding rope units object
wrong order 'base = [r[:4] + [r[7]] + r[4:7] for r in base]' && expect_finding order quaternion-order base
wrong size 'for c in capture["cameras"]:
    for key in ("fx", "fy", "cx", "cy"): c[key] *= 2' && expect_finding size image-size cameras
wrong swapped 'a, b = capture["cameras"][:2]
for key in ("images", "masks"): a[key], b[key] = b[key], a[key]' && expect_finding swapped swapped-videos cam0
wrong heavy 'capture["object"]["mass"] = 70.0' && expect_finding heavy mass object
wrong lens 'capture["cameras"][0]["distortion_model"] = "equidistant"'
expect_error 2 'lens model .equidistant. is not known' train "$work/lens" -o "$work/run" -q
finish
