#!/bin/bash
# tools/perturb: what faults.json says is what was done, nothing else changes, and the program reads the result. Skipped
# (77) without Debian's python3-numpy and ffmpeg, which nothing else needs.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent
demo=$source_dir/assets/demo_free_30
if ! /usr/bin/python3 -c 'import numpy' 2>/dev/null || ! command -v ffmpeg >/dev/null; then
  echo 'skipped: no python3-numpy or no ffmpeg'
  exit 77
fi

capture=$demo

perturb() {  # name options...: $capture into $work/name
  local name=$1
  shift
  "$source_dir/tools/perturb" "$capture" "$work/$name" "$@" >"$work/stdout" 2>"$work/stderr"
  code=$?
  expect_code 0 "perturb $*"
  [ -s "$work/stderr" ] && fail "perturb $*: something on standard error"
}

refused() {  # pattern options...
  local pattern=$1
  shift
  "$source_dir/tools/perturb" "$demo" "$@" >"$work/stdout" 2>"$work/stderr"
  code=$?
  expect_code 2 "perturb $*"
  [ "$(grep -Ec '^perturb: error: .+: .+; .+$' "$work/stderr")" -eq 1 ] ||
    fail "perturb $*: not one line WHERE: WHAT; HOW TO MEND"
  grep -Eq -- "$pattern" "$work/stderr" || fail "perturb $*: the line does not match '$pattern'"
}

reads() {  # name code pattern: of what `check` says
  run check "$work/$1"
  expect_code "$2" "check $1"
  expect_output "$3" "check $1"
}

# the same seed, the same bytes; another one, others
perturb small --small --only cam1 --seed 3
perturb again --small --only cam1 --seed 3
diff -r "$work/small" "$work/again" >/dev/null || fail 'the same seed gives other bytes'
rm -r "$work/again"
perturb other --camera-rotation 0.2 --seed 4
cmp -s "$work/small/faults.json" "$work/other/faults.json" && fail 'another seed gives the same faults'
reads small 0 '^cam1: .* 60 frames'

# one fault more changes no draw of the others
perturb more --camera-rotation 0.2 --camera-translation 2 --focal 0.002 --seed 3
# clocks, masks, images and frames one by one, so that each can be measured
perturb clock --base-late 40 --camera-time 20 --plus --only cam2
perturb masks --holes 3 --only cam0
perturb gain --gain 0.3 --only cam0
perturb frames --dropped 3 --doubled 2 --missing-masks 0.1 --only cam1
perturb motion --blur 0.8 --rolling-shutter 20 --only cam2
# a base that turns about two axes, so that it matters in which frame the grasp is off
mkdir "$work/turning"
cp -r "$demo"/{capture.json,cam?.mp4,masks} "$work/turning"
awk '{ print $1, $2, $3, $4, 0.6 * sin($1), 0, 0.8 * sin($1), cos($1) }' "$demo/base.tum" >"$work/turning/base.tum"
capture=$work/turning
perturb off --grasp-translation 20 --grasp-rotation 10
capture=$demo
/usr/bin/python3 - "$demo" "$work" 2>&1 <<'SCRIPT' || fail 'faults.json does not say what was done'
import filecmp, json, pathlib, subprocess, sys
import numpy as np
demo, work = map(pathlib.Path, sys.argv[1:])
failures = 0

def expect(good, what):
    global failures
    if not good:
        print(f"FAILED: {what}")
        failures += 1

def read(folder, name="capture.json"):
    return json.loads((folder / name).read_text())

def camera(folder, name):
    return next(c for c in read(folder)["cameras"] if c["name"] == name)

def pose(values):
    return np.array(values, float).reshape(4, 4)

def frames(folder, name, key, channels):
    c = camera(folder, name)
    raw = subprocess.run(["ffmpeg", "-v", "error", "-i", c[key], "-f", "rawvideo", "-pix_fmt",
                          "gray" if channels == 1 else "rgb24", "-"], cwd=folder, check=True, capture_output=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, c["height"], c["width"], channels)

def base(folder):
    return np.array([line.split() for line in (folder / "base.tum").read_text().splitlines()], float)

def matrix(q):
    x, y, z, w = q
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])

def unchanged(folder, but):
    """All files of the demo but those that begin with one of `but` are there byte for byte, and no others beside them."""
    for path in demo.rglob("*"):
        name = str(path.relative_to(demo))
        if path.is_file() and not name.startswith(but):
            same = (folder / name).is_file() and filecmp.cmp(path, folder / name, shallow=False)
            expect(same, f"{folder.name}: {name} changed")
    for path in folder.rglob("*"):
        name = str(path.relative_to(folder))
        known = path.is_dir() or (demo / name).is_file() or name.startswith(("faults.json", *but))
        expect(known, f"{folder.name}: {name} is new")

# calibration, grasp, noise and clock of --small
small = work / "small"
unchanged(small, ("capture.json", "base.tum", "cam1", "masks/cam1"))
faults = read(small, "faults.json")
said, true, given = faults["cameras"]["cam1"], camera(demo, "cam1"), camera(small, "cam1")
expect(faults["format"] == "chainsplat-faults/1" and faults["cameras"]["cam0"] == {}, "format, or a fault of cam0")
found = np.linalg.inv(pose(true["world_from_camera"])) @ pose(given["world_from_camera"])
expect(np.allclose(found, pose(said["true_from_given"]), atol=1e-8), "true_from_given of cam1")
expect(np.isclose(np.degrees(np.arccos((np.trace(found[:3, :3]) - 1) / 2)), 0.2, atol=1e-3), "0.2 degrees")
expect(np.isclose(np.linalg.norm(found[:3, 3]), 2e-3), "2 mm")
expect(np.isclose(given["fx"] / true["fx"] - 1, said["focal"]) and abs(said["focal"]) == 0.002, "focal length")
expect(np.isclose(read(small)["object"]["length"], 0.3 * 1.007) and faults["object"]["length"] == 0.007, "length")
before, after, grasp = base(demo), base(small), pose(faults["base"]["true_from_given"])
front, behind = faults["base"]["rows_added"]
after = after[front:len(after) - behind]
expect(np.allclose(after[:, 0] - before[:, 0], 8e-3, atol=2e-6), "8 ms late")
turns = [matrix(q) for q in before[:, 4:]]
miss = [r.T @ (a[1:4] - b[1:4]) - grasp[:3, 3] for r, a, b in zip(turns, after, before)]
expect(np.isclose(np.linalg.norm(grasp[:3, 3]), 1.5e-3), "1.5 mm off the grasp")
expect(np.isclose(1e3 * np.std(miss), 0.3, rtol=0.1) and np.abs(np.mean(miss, 0)).max() < 1e-4, "0.3 mm of noise")
angles = [np.arccos(np.clip((np.trace((r @ grasp[:3, :3]).T @ matrix(a[4:])) - 1) / 2, -1, 1))
          for r, a in zip(turns, after)]
expect(np.isclose(np.degrees(np.sqrt(np.mean(np.square(angles)) / 3)), 0.2, rtol=0.1), "0.2 degrees of noise")

# the grasp under a base that turns
grasp = pose(read(work / "off", "faults.json")["base"]["true_from_given"])
for old, new in zip(base(work / "turning"), base(work / "off")):
    r = matrix(old[4:])
    good = np.allclose(r @ grasp[:3, 3] + old[1:4], new[1:4], atol=1e-6)
    if not good or not np.allclose(r @ grasp[:3, :3], matrix(new[4:]), atol=1e-6):
        expect(False, f"the grasp at {old[0]} s")
        break

# fewer faults, the same draws; nothing but capture.json changes
unchanged(work / "more", ("capture.json",))
expect(camera(work / "more", "cam1")["world_from_camera"] == given["world_from_camera"], "draws depend on the other faults")

# clocks: every frame is covered, and what was added goes on smoothly
clock, rows = work / "clock", base(work / "clock")
unchanged(clock, ("capture.json", "base.tum"))
faults = read(clock, "faults.json")
expect(faults["cameras"]["cam2"]["late_ms"] == 20 and camera(clock, "cam2")["start"] == 0.02, "cam2 20 ms late")
expect(rows[0, 0] <= 0 and rows[-1, 0] >= 59 / 30 + 0.02 and np.all(np.diff(rows[:, 0]) > 0.008), "the base covers all frames")
front, behind = faults["base"]["rows_added"]
expect(np.allclose(rows[front:len(rows) - behind, 0] - before[:, 0], 0.04, atol=2e-6), "40 ms late")

# masks and images
masks, faults = work / "masks", read(work / "masks", "faults.json")
unchanged(masks, ("masks/cam0",))
holes = np.count_nonzero(frames(demo, "cam0", "masks", 1)) - np.count_nonzero(frames(masks, "cam0", "masks", 1))
expect(holes == faults["cameras"]["cam0"]["holes"]["px"] > 60, "pixels in holes")
gain, faults = work / "gain", read(work / "gain", "faults.json")
unchanged(gain, ("capture.json", "cam0"))
true, given = (frames(folder, "cam0", "images", 3).astype(float) for folder in (demo, gain))
expect(np.abs(np.minimum(255, true * faults["cameras"]["cam0"]["gain"]) - given).max() <= 0.51, "gain of cam0")

# frames: each place shows the frame that faults.json lets expect, in images, masks and depth alike
lost, faults = work / "frames", read(work / "frames", "faults.json")["cameras"]["cam1"]
unchanged(lost, ("capture.json", "cam1", "masks/cam1", "depth/cam1"))
order = list(range(60))
for k in faults["doubled"]:
    order[k + 1] = order[k]
order = [frame for k, frame in enumerate(order) if k not in faults["dropped"]]
expect(len(order) == 57 and len(faults["missing_masks"]) == 6, "frames that are lost")
expect(np.array_equal(frames(demo, "cam1", "images", 3)[order], frames(lost, "cam1", "images", 3)), "images of lost frames")
wanted = frames(demo, "cam1", "masks", 1).copy()
wanted[faults["missing_masks"]] = 0
expect(np.array_equal(wanted[order], frames(lost, "cam1", "masks", 1)), "masks of lost frames")
expect(all(filecmp.cmp(demo / f"depth/cam1/{k:06d}.png", lost / f"depth/cam1/{place:06d}.png", shallow=False)
           for place, k in enumerate(order)), "depth of lost frames")

# the shutter: masks move, but not far
true, given = (frames(work / folder, "cam2", "masks", 1) > 127 for folder in (demo, "motion"))
overlap = np.count_nonzero(true & given) / np.count_nonzero(true | given)
expect(0.5 < overlap < 0.95 and len(given) == 60, f"masks under a rolling shutter overlap by {overlap:.3f}")
sys.exit(failures > 0)
SCRIPT

# the program reads what was written, and finds what is badly wrong
reads gain 0 "^found: cam0's pictures are .* darker than all cameras' mean: corrected"
reads frames 0 '^cam1: .* 57 frames'
reads motion 0 '^cam2: .* 60 frames'
reads clock 0 '^cam2: .* 0\.020 to 1\.987 s'
perturb lossy --recompress 30 --only cam2
reads lossy 0 '^cam2: .* 60 frames'
perturb inverse --inverse-poses --only cam1
reads inverse 2 "^problem: cam1's world_from_camera is the pose of the world"
perturb axes --opengl-axes
reads axes 2 "^problem: the cameras' world_from_camera has OpenGL"
perturb units --millimeters object
reads units 2 '^problem: .*object\.length'
perturb size --calibration-scale 2
reads size 2 '^problem: .*cam0\.mp4: is 320x240'

# what is refused, leaving nothing
refused 'units: exists' "$work/units" --grams
refused 'cam9: is no camera' "$work/none" --focal 0.1 --only cam9
refused '--gain: -1 is no size' "$work/none" --gain -1
refused 'no fault is asked for' "$work/none"
refused 'lies in the capture itself' "$demo/none" --grams
[ -z "$(find "$work" "$demo" -maxdepth 1 -name 'none*')" ] || fail 'refused: something was written'
finish
