#!/bin/bash
# One rope through the whole program, on four threads: train, rollout, render, estimate, force, plan, export. For builds
# with sanitizers, whose report fails the command; what the commands write has tests of its own.
. "$(dirname "$0")/lib.sh"
demo=$source_dir/assets/demo_free_30
twin=$work/twin

work_through() {  # file that must have something in it, arguments of the program
  local file=$1
  shift
  run --threads 4 "$@"
  expect_code 0 "$*"
  [ -s "$file" ] || fail "$*: nothing in $file"
}

work_through "$twin/rollout.csv" train "$demo" -o "$twin" --joints 3 --bending planar --frames 0:12
work_through "$work/states.csv" rollout "$twin" --base "$demo/base.tum" -o "$work/states.csv"
work_through "$work/frames/cam1/000000.png" render "$twin" --camera "$demo:cam1" -o "$work/frames"
work_through "$work/video.mp4" render "$twin" --camera "$demo:cam0" -o "$work/video.mp4"
work_through "$work/stdout" eval "$twin" "$demo" --frames 0:12
work_through "$work/stdout" force "$twin" --states "$twin/states.csv" --base "$demo/base.tum"
work_through "$work/plan/plan.json" plan "$twin" --target 0.1,0,0.27 --horizon 1 --starts 4 -o "$work/plan"
work_through "$work/twin.glb" export "$twin" -o "$work/twin.glb"

# the live window's server, asked by somebody for as long as the estimator runs
port=$((20000 + $$ % 20000))
(while [ ! -e "$work/enough" ]; do
  python3 -c "
import urllib.request
print(len(urllib.request.urlopen('http://127.0.0.1:$port/next?after=0', timeout=5).read()))" 2>/dev/null || sleep 0.05
done) >"$work/asked" &
browser=$!
work_through "$work/stdout" estimate "$twin" --camera "$demo:cam0" --serve "$port"
touch "$work/enough"
wait "$browser"
[ -s "$work/asked" ] || fail 'estimate --serve: no answer to anybody'
finish
