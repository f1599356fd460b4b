#!/bin/bash
# Help, version, doctor and wrong command lines; nothing here needs a Vulkan device.
. "$(dirname "$0")/lib.sh"
export VK_DRIVER_FILES=/nonexistent VK_ICD_FILENAMES=/nonexistent

run --version
expect_code 0 --version
expect_output '^chainsplat [0-9]+\.[0-9]+\.[0-9]+$' --version
run --help
expect_code 0 --help
for command in train recognize identify new calibrate import check mask rollout render eval export synth estimate force plan excite batch diff bench doctor; do
  expect_output "^ +$command " --help
  run "$command" --help
  expect_code 0 "$command --help"
  expect_output "$command" "$command --help"
  awk 'length > 80 { exit 1 }' "$work/stdout" || fail "$command --help: a line is wider than 80 columns"
  run --help
done

run doctor
expect_code 0 doctor
expect_output 'none' doctor
run doctor --json
expect_code 0 'doctor --json'
expect_output '^ "chosen": null' 'doctor --json'
[ "$(head -c 1 "$work/stdout")" = '{' ] || fail 'doctor --json: does not begin with {'

expect_error 2 'subcommand'
expect_error 2 'dance: is not a command' dance
expect_error 2 "tarin: is not a command; did you mean 'train'?" tarin capture
expect_error 2 "did you mean '--joints'?" train capture -o run --joins 4
expect_error 2 "did you mean '--picture'?" train capture -o run --pictrue=x.png

# completions and manual pages, made from the commands themselves
complete_bash() { bash -c 'source "$1"; COMP_WORDS=("${@:2}"); COMP_CWORD=$(($# - 2)); _chainsplat; echo "${COMPREPLY[@]}"' - "$work/bash" "$@"; }
for shell in bash zsh fish; do
  run completions $shell
  expect_code 0 "completions $shell"
  cp "$work/stdout" "$work/$shell"
  command -v $shell >/dev/null && { $shell -n "$work/$shell" || fail "completions $shell: does not parse"; }
done
[ "$(complete_bash chainsplat tra)" = train ] || fail 'completions bash: no train'
[ "$(complete_bash chainsplat --json train capture --pic)" = --picture ] || fail 'completions bash: no --picture of train'
[ "$(complete_bash chainsplat export run --thr)" = --threads ] || fail 'completions bash: no global option'
rm "$work"/{bash,zsh,fish}
for command in '' train export; do
  run manual $command
  expect_code 0 "manual $command"
  grep -q '^\.SH OPTIONS' "$work/stdout" || fail "manual $command: no options"
  if command -v groff >/dev/null; then
    [ -z "$(groff -ww -man -Tutf8 "$work/stdout" 2>&1 >/dev/null)" ] || fail "manual $command: groff complains"
  fi
done
expect_error 2 'dance: is not a command' manual dance
expect_error 2 'CAPTURE' train
expect_error 2 '--output' train capture
expect_error 2 'nonsense' train capture -o run --nonsense
expect_error 2 'joints' train capture -o run --joints none
expect_error 2 'joints' train capture -o run --joints 0
expect_error 2 "--every: '-1' is not a number above 0; " train capture -o run --every -1
expect_error 2 'bending' train capture -o run --bending sideways
expect_error 2 'polish' train capture -o run --stages recognize,polish
expect_error 2 '--frames' train capture -o run --frames 5:5
expect_error 2 '--frames' train capture -o run --frames some
expect_error 2 'twin.json' rollout "$work/none" -o "$work/states.csv"
expect_error 2 "ending '.obj' is not known; choose one of .*[.]urdf" export "$work/none" -o "$work/twin.obj"
run check ''
expect_code 2 "check ''"
grep -q "^chainsplat: error: '': " "$work/stderr" || fail "check '': the error line has an empty place"
for command in 'rollout none' 'render none --camera none' 'export none' 'train none' 'mask none' 'eval none none'; do
  expect_error 2 '--output: is empty' $command -o ''
done
expect_error 2 'twin.json' excite "$work/none" -o "$work/motion"
expect_error 2 '--output' excite "$work/none"
expect_error 2 'twin.json' identify "$work/none" --online "$work/none.jsonl"
expect_error 2 '--online' identify "$work/none" --memory 3
expect_error 2 'folder does not exist' rollout "$work/none" -o "$work/none/states.csv"
[ "$(ls "$work")" = "$(printf 'stderr\nstdout')" ] || fail 'something was written'

# a base that is beyond all numbers is none
cp -r "$source_dir/assets/demo_free_30" "$work/beyond"
awk '!/^#/ && n++ % 2 { $2 = 1e300 } { print }' "$source_dir/assets/demo_free_30/base.tum" >"$work/beyond/base.tum"
run check "$work/beyond"
expect_code 2 'a base beyond all numbers'
expect_output '^problem: .*base' 'a base beyond all numbers'
rm -r "$work/beyond"

# a full disk under standard output, and none at all
for arguments in doctor --version --help 'estimate --help'; do
  "$program" $arguments >/dev/full 2>"$work/stderr"
  code=$?
  expect_code 1 "$arguments >/dev/full"
  [ "$(grep -c '^chainsplat: error: standard output: ' "$work/stderr")" -eq 1 ] || fail "$arguments >/dev/full: no error line"
  "$program" $arguments >&- 2>"$work/stderr"
  code=$?
  expect_code 1 "$arguments >&-"
  [ "$(grep -c '^chainsplat: error: standard output: ' "$work/stderr")" -eq 1 ] || fail "$arguments >&-: no error line"
done

# nobody reads: an end without a word
for arguments in doctor --version --help; do
  { sleep 0.1; "$program" $arguments 2>"$work/stderr"; echo $? >"$work/code"; } | true
  [ "$(cat "$work/code")" -eq 141 ] || fail "$arguments, and nobody reads: exit code $(cat "$work/code")"
  [ -s "$work/stderr" ] && fail "$arguments, and nobody reads: it says something"
done

# a limit on the address space: a line, not an abort in a library (sanitizers need more than any limit)
if (ulimit -v 4000000 && exec "$program" --version) >/dev/null 2>&1; then
  for limit in 470000 500000; do
    (ulimit -v $limit && exec "$program" --version) >"$work/stdout" 2>"$work/stderr"
    code=$?
    expect_code 1 "ulimit -v $limit"
    grep -q '^chainsplat: error: address space: .*; raise it' "$work/stderr" || fail "ulimit -v $limit: no error line"
  done
fi

# with a stream closed, the program's own files do not become that stream
run new --length 0.3 --joints 2 --bending planar -o "$work/twin"
expect_code 0 new
"$program" rollout "$work/twin" -o "$work/states.csv" --log "$work/log.jsonl" 2>&- >"$work/stdout"
code=$?
expect_code 2 'rollout with standard error closed'
[ -e "$work/log.jsonl" ] || fail 'rollout with standard error closed: no log'
[ -s "$work/log.jsonl" ] && fail "rollout with standard error closed: in its log '$(cat "$work/log.jsonl")'"

# the libraries that bring hundreds of others are loaded where an image is read, and missed there in one line
ldd "$program" | grep -E 'OpenImageIO|libav|opencv_dnn' && fail 'the program itself links OpenImageIO, libav or networks'
cp "$program" "$work/alone"
[ "$("$work/alone" --version)" = "$("$program" --version)" ] || fail 'alone: no version'
program=$work/alone
expect_error 1 'chainsplat_(images|videos).so: cannot be loaded .*; install' check "$source_dir/assets/demo_free_30"
expect_error 1 'chainsplat_networks.so: cannot be loaded .*LPIPS needs it: install' eval "$work/twin" "$source_dir/assets/demo_free_30" \
  --lpips "$source_dir/tests/data/lpips/trunk.onnx"
finish
