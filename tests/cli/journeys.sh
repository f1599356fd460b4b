#!/bin/bash
# The journeys of examples/ from raw files to a twin. The captures that come out are the demo again: what import undoes
# was done by tools/make_raw_files, which shares no code with it.
. "$(dirname "$0")/lib.sh"
PATH="$(dirname "$program"):$PATH"
demo=$source_dir/assets/demo_free_30

same() {  # folder: cameras, base motion and frame times of the capture are the demo's, up to the grasp's frame and the clock
  python3 - "$1" "$demo" <<'END' || fail "$1: is not the demo"
import json, math, pathlib, sys
made, demo = (json.loads((pathlib.Path(p) / "capture.json").read_text()) for p in sys.argv[1:])
poses = lambda p: [[float(v) for v in l.split()] for l in (pathlib.Path(p) / "base.tum").read_text().splitlines() if l[0] != "#"]
worst = {"px": 0.0, "pose": 0.0, "base": 0.0, "time": 0.0}
for a, b in zip(made["cameras"], demo["cameras"]):
    assert (a["name"], a["width"], a["height"]) == (b["name"], b["width"], b["height"])
    worst["px"] = max([worst["px"]] + [abs(a[k] - b[k]) for k in ("fx", "fy", "cx", "cy")])
    worst["pose"] = max([worst["pose"]] + [abs(x - y) for x, y in zip(a["world_from_camera"], b["world_from_camera"])])
def turned(q, v):
    x, y, z, w = q
    t = [2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])]
    return [v[0] + w * t[0] + y * t[2] - z * t[1], v[1] + w * t[1] + z * t[0] - x * t[2], v[2] + w * t[2] + x * t[1] - y * t[0]]
base = poses(sys.argv[1])
begin = base[0][0]
for a, b in zip(base, poses(sys.argv[2])):
    worst["time"] = max(worst["time"], abs(a[0] - begin - b[0]))
    worst["base"] = max([worst["base"]] + [abs(x - y) for x, y in zip(a[1:4], b[1:4])])
    worst["base"] = max([worst["base"]] + [abs(x - y) for x, y in zip(turned(a[4:], made["grasp"]["direction"]),
                                                                   turned(b[4:], demo["grasp"]["direction"]))])
for camera in made["cameras"]:
    times = [float(l) for l in (pathlib.Path(sys.argv[1]) / camera["timestamps"]).read_text().split()]
    worst["time"] = max([worst["time"]] + [abs(t - begin - k / 30) for k, t in enumerate(times)])
print(worst)
assert worst["px"] < 1e-8 and worst["pose"] < 1e-6 and worst["base"] < 1e-6 and worst["time"] < 2e-6, worst
END
}
good_twin() {  # folder least_iou
  python3 - "$1/run" "$2" <<'END' || fail "$1: the twin is not good"
import json, sys
twin, metrics = (json.load(open(f"{sys.argv[1]}/{name}.json")) for name in ("twin", "metrics"))
iou = metrics["rollout"]["mean"]["iou"]
print("rollout IoU", iou, [f["text"] for f in twin["verdict"]])
assert twin["trusted"] and iou > float(sys.argv[2])
END
}

for journey in opencv_csv kalibr_tum; do
  script=$source_dir/examples/from_$journey
  [ "$(grep -c '^chainsplat' "$script")" -le 8 ] || fail "$script: more than eight commands"
  "$script" "$work/$journey" >"$work/stdout" 2>"$work/stderr" || fail "examples/from_$journey"
  same "$work/$journey/capture"
  for camera in cam0 cam1 cam2; do
    [ -s "$work/$journey/capture/pictures/$camera.png" ] || fail "$journey: no picture of $camera"
  done
done
good_twin "$work/opencv_csv" 0.95
good_twin "$work/kalibr_tum" 0.85
[ -s "$work/opencv_csv/run.glb" ] || fail 'opencv_csv: no run.glb'
finish
